"""docs/transport.md: what shadows and bounces cost and how right they are."""

import torch

from augment.reshading import NEAR
from renderer.files.mitsuba_scene import DIFFERENTIABLE, mitsuba
from renderer.mesh import normalise
from renderer.shapes import solid
from renderer.subdivision import subdivide
from renderer.transport.radiosity import PATCHES
from renderer.transport.rays import DIRECTIONS
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_file
from train.run_folder.classifier import load_classifier
from train.studies.page import filled, joined, machine, wrapped, write
from train.studies.renderer_speed.measure import Clock
from train.studies.transport import beside_mitsuba, cost, held
from train.studies.transport.cost import CupSettings

SIZES = (32, 224)


def run(settings: CupSettings) -> None:
    """Measure on one thread, and write the page."""
    out = writable_file(settings.out, "out")
    with mitsuba(DIFFERENTIABLE):
        pass  # a run without it would fail only at its end
    torch.set_num_threads(1)
    coarse, clock = normalise(solid("cup", 0)), Clock(torch.device("cpu"), settings.rounds)
    cup = subdivide(coarse, settings.vertices)
    grey, orange = cost.painted(cup, (0.5, 0.5, 0.5)), cost.painted(cup, (0.9, 0.5, 0.2))
    meshes = {"several colours": cup, "one grey": grey, "one colour": orange}
    text = filled(
        __file__,
        command=command_line(),
        machine=machine(clock.device),
        faces=len(cup.faces),
        vertices=len(cup.vertices),
        views=cost.VIEWS,
        costs=cost.costs(meshes, SIZES, clock),
        size=SIZES[0],
        maps=cost.depth_maps(cup),
        resolution=cost.RESOLUTION,
        directions=DIRECTIONS,
        near=NEAR,
        examples=held.EXAMPLES,
        own=len(coarse.faces),
        steps=held.STEPS,
        step=held.STEP.step_size,
        radius=held.STEP.radius,
        held=held.table(coarse, load_classifier("run:pretrained/none", None)),
        seeds=beside_mitsuba.SEEDS,
        fine=beside_mitsuba.CONVERGED,
        samples=beside_mitsuba.SAMPLES,
        patches=PATCHES,
        props=beside_mitsuba.table(),
    )
    write(out, joined([wrapped(text)]))
