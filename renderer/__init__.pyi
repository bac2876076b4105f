from renderer.camera import Camera as Camera
from renderer.camera import OrthographicCamera as OrthographicCamera
from renderer.camera import PerspectiveCamera as PerspectiveCamera
from renderer.camera import orbit_cameras as orbit_cameras
from renderer.errors import InputError as InputError
from renderer.fitting import FittedScene as FittedScene
from renderer.fitting import fit_scene as fit_scene
from renderer.geometry.mesh import Mesh as Mesh
from renderer.geometry.mesh import normalize as normalize
from renderer.geometry.mesh import subdivide as subdivide
from renderer.geometry.shapes import solid as solid
from renderer.io.export import export_mesh as export_mesh
from renderer.io.meshes import load_mesh as load_mesh
from renderer.light import harmonics as harmonics
from renderer.light import skylight as skylight
from renderer.light.lamps import Lamps as Lamps
from renderer.light.light_files import save_light as save_light
from renderer.light.presets import load_light as load_light
from renderer.light.projector import Projector as Projector
from renderer.rendering import light_sphere as light_sphere
from renderer.rendering import precompute_transfer as precompute_transfer
from renderer.rendering import render as render
from renderer.settings import ImageSettings as ImageSettings
from renderer.shading.gloss import Gloss as Gloss
from renderer.transport.operator_stacks import TransferOperators as TransferOperators
from renderer.transport.operators import TransferOperator as TransferOperator

__version__: str
