"""All parameters that an attack changes, as one vector of values."""

import warnings
from collections.abc import Sequence
from functools import cached_property

import torch
from jaxtyping import Int
from torch import Tensor

from augment.attack_settings import AttackSettings
from augment.attacks.objective import Examples, Images, Values
from augment.attacks.parameters import make_parameter
from augment.attacks.parameters.lights import Skylight
from augment.attacks.parameters.material import Material
from augment.attacks.parameters.offsets import Albedo, Geometry, Pixels
from augment.attacks.parameters.parameter import Parameter
from augment.attacks.parameters.pose import Pose
from augment.classifier import TaskNetwork
from augment.progress import progress
from augment.scene.build import MAX_IRRADIANCE_ERROR
from augment.scene.objects import Conditions
from augment.scene.scene import Scene
from augment.scene.truth import Truth, unlabeled
from renderer.light.harmonics import irradiance_error


class SceneProblem:
    """A scene, and the parameters of it that an attack changes, such as lighting and pose.

    Each of the E examples of the scene has a vector of D attack values. It
    contains the values of the first parameter, then those of the second, and so
    on.

    Attributes:
        scene: Scene to attack.
        parameters: Parameters to change, made for this scene.
        start: Values at which attacks start, one row for each example, shape (E, D).
        all_examples: Indices of all examples, shape (E,).
        group_size: Largest number of examples that are rendered at the same time,
            so that they fit in memory.
    """

    def __init__(self, scene: Scene, parameters: Sequence[Parameter]):
        """Join the initial values of all parameters."""
        self.scene = scene
        self.parameters = parameters
        self.group_size = scene.group_size
        self.start = torch.cat([each.start.to(scene.lights) for each in parameters], dim=1)
        self.all_examples = torch.arange(len(scene), device=self.start.device)
        self._value_counts = [parameter.start.shape[1] for parameter in parameters]

    def conditions(self, values: Values, examples: Examples) -> Conditions:
        """Convert attack values of examples to conditions, differentiable in the values.

        What no parameter changes is that of the scene. `examples` are indices in the scene.
        """
        conditions = self.scene.conditions(examples)
        for parameter, parameter_values in self.split_by_parameter(values):
            conditions = parameter.apply(parameter_values, conditions, examples)
        return conditions

    def render(self, values: Values, examples: Examples, is_draft: bool = True) -> Images:
        """Render the V views of each example: drafts for a search (`Scene.render`), or exact."""
        return self.scene.render(self.conditions(values, examples), examples, is_draft)

    @torch.no_grad()
    def images(self, values: Values, examples: Int[Tensor, " A"] | None = None) -> Tensor:
        """Render the V views of examples without gradients, `group_size` examples at a time.

        The values are those of all E examples. `examples` are the indices of those to render, and
        None renders all.
        """
        if examples is None:
            examples = self.all_examples
        groups = progress(examples.split(self.group_size), "images")
        return torch.cat([self.render(values[group], group, is_draft=False) for group in groups])

    def truth(self, values: Values, examples: Examples) -> Truth:
        """Find where the objects are in the images, which attacks on shape and pose move."""
        conditions = self.conditions(values, examples)
        if conditions.vertices is None and conditions.cameras is None:
            return self._still_truth.select(examples)
        return self.scene.truth(unlabeled, examples, conditions)

    @cached_property
    def _still_truth(self) -> Truth:
        """Where the objects of all examples are before any attack."""
        return self.scene.truth(unlabeled)

    def scale_gradient(self, gradient: Values) -> Values:
        """Compute the step of each parameter that gradient descent subtracts from the values."""
        parts = self.split_by_parameter(gradient)
        return torch.cat([parameter.scale_gradient(part) for parameter, part in parts], dim=1)

    def search_scale(self, examples: Examples) -> Values:
        """Return how much random search should change each attack value at first."""
        scales = [parameter.search_scale(examples) for parameter in self.parameters]
        return torch.cat(scales, dim=1).to(self.start)

    def project(self, values: Values, examples: Examples) -> Values:
        """Find the nearest values that are feasible and lie in the norm-balls.

        The values of each parameter are projected separately.
        """
        parts = self.split_by_parameter(values)
        return torch.cat([parameter.project(part, examples) for parameter, part in parts], dim=1)

    def sample(self, generator: torch.Generator, reached: Values | None = None) -> Values:
        """Draw random feasible attack values for all examples.

        A parameter with a radius draws from its norm-ball. A parameter without one draws changes
        that are as long as those of an attack. `reached` are the values at the end of this attack.
        They are needed only if a parameter has no radius.
        """
        parts = self.split_by_parameter(self.start if reached is None else reached)
        samples = [one.sample(generator, None if reached is None else part) for one, part in parts]
        return torch.cat(samples, dim=1).to(self.start)

    def split_by_parameter(self, values: Values) -> list[tuple[Parameter, Tensor]]:
        """Split the attack values of examples into the values of each parameter."""
        return list(zip(self.parameters, values.split(self._value_counts, dim=1), strict=True))


def build_problem(settings: AttackSettings, scene: Scene) -> SceneProblem:
    """Prepare an attack on a scene.

    Unless `settings.allow_negative`, negative radiance is first removed from the light of the
    scene.
    """
    scene.require_memory()
    if not settings.allow_negative:
        physical = scene.basis.project_nonnegative(scene.lights)
        if not torch.equal(physical, scene.lights):
            scene = scene.changed(lights=physical)
    if settings.parameters.keys() <= {kind.name for kind in (Albedo, Geometry, Material, Pose)}:
        # Each view has one light, so operators would take more time than they save.
        scene = scene.changed(one_light=True)
    elif scene.one_light and scene.needs_rays:
        # Shadows and bounces would stay those of the first light.
        scene = scene.changed(one_light=False)
    of_light = {"nonnegative": not settings.allow_negative}
    options = {"lighting": of_light, Skylight.name: of_light}
    options[Pixels.name] = {"is_alone": len(settings.parameters) == 1}
    parameters = [
        make_parameter(name, scene, steps, **options.get(name, {}))
        for name, steps in settings.parameters.items()
    ]
    return SceneProblem(scene, parameters)


def warn_of_changed_light(given: Scene, physical: Scene, stacklevel: int = 3) -> None:
    """Warn if the removal of negative radiance changes the irradiance by more than 5 %.

    The change is the rms error of the irradiance over all normals and channels,
    divided by the rms irradiance of the given environment light. The largest
    change of all examples counts.
    """
    if physical.lights is given.lights or torch.equal(physical.lights, given.lights):
        return
    # The environment is the first light of a scene.
    rows, basis = given.basis.lights[0]
    error = float(irradiance_error(physical.lights[:, rows], given.lights[:, rows]).max())
    if error > MAX_IRRADIANCE_ERROR:
        reason = "the light has negative radiance, and after its removal the irradiance is off by"
        advice = "give a higher degree, or set allow_negative=True to keep the light as it is"
        warnings.warn(f"{reason} {error:.0%} (rms) in {basis}: {advice}", stacklevel=stacklevel)


def source_labels(scene: Scene, device: torch.device, network: TaskNetwork) -> Int[Tensor, "E V"]:
    """Return the true class of each view as an index of the network."""
    labels = [network.label(label) for label in scene.labels]
    return torch.tensor(labels, device=device)[:, None].expand(-1, scene.views)
