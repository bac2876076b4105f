"""docs/transport.md: what shadows and bounces cost and how right they are."""

from dataclasses import dataclass

import torch

from augment.held_transport import NEAR
from renderer.errors import require_range
from renderer.files.mitsuba_scene import DIFFERENTIABLE, mitsuba
from renderer.mesh import normalise
from renderer.shapes import solid
from renderer.subdivision import MOST_VERTICES, subdivide
from renderer.transport.radiosity import PATCHES
from renderer.transport.rays import DIRECTIONS
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_file
from train.run_folder.classifier import load_classifier
from train.studies.page import joined, machine, wrapped, write
from train.studies.renderer_speed.measure import MOST_ROUNDS, Clock
from train.studies.transport import beside_mitsuba, cost, held

SIZES = (32, 224)
COLORS = {"several colours": None, "one grey": (0.5, 0.5, 0.5), "one colour": (0.9, 0.5, 0.2)}

TEXT = """
# Shadows and bounces

`{command}` measures everything on this page in one run and writes it; do not edit.

{machine}

`renderer.transport=shadows` folds the shadows that a mesh casts on itself into its operators, and `bounces:N` also the
light that its surfaces send each other N times, by precomputed radiance transfer (Sloan, Kautz and Snyder 2002). A step
of an attack remains one product.

## Cost

A cup of {faces:,} faces ({vertices:,} vertices), 8² samples per pixel, {views} views around it; time is the process's
own, on one thread: of operators the lesser of two, of steps the median of rounds in which the transports take turns.
*MB* is all views' operators. A light step is image, clamp and the gradient of a loss by the light, of one view. Light
that bounces off a colour is of that colour, so that a mesh of one that is not grey then needs three channels.

{costs}

## Time against error

Shadows by the number of directions over the sphere, of which a pixel casts rays in the half above it: root mean square
error of the radiance of two views at {size}² in the Grace light against {converged:,} directions, over the brightest.

{by_rays}

Rays are cast by Embree (embreex, which trimesh uses, too). The other way, the mesh's depth maps as seen from each
direction, would take {maps:.1f} s for {directions} maps of {resolution}² alone, on the software rasteriser, and is only
as sharp as they are; rays are exact to their offset of 1e-5 of the mesh's extent. A face that no surface rises above,
any of a convex mesh, casts none and keeps its closed form to the bit.

## Shadows held while vertices move

An attack on the shape or on the albedo differentiates shading, and takes from a shape close by what transport adds to
each pixel: it is found anew once a coordinate has moved by more than {near} since it was, and in the end, when an
adversary's files are rendered. {examples} views of the cup of {own:,} faces at {size}² that `pretrained/none`
recognises are attacked by {steps} signed steps at most of {step} within {radius}, which move every coordinate at each
step. Errors are against transport of the very shape where the attack ended, of the image as above and of the gradient
of the cost by the vertices in L2 norm; the last column counts those that then still fool.

{held}

## Beside Mitsuba's path tracer

The same mesh at {size}² in the same environment map (St. Peter's, positive all round), with {directions} directions
and 8² samples here, and {seeds} × 256 paths per pixel of depth N + 2 there. An image's errors are root mean squares
over the brightest value, inside the outline. The gradient is that by the light, all 49 × 3 coefficients, of the sum of
these pixels with random weights, and Mitsuba's is its integrator's in reverse mode; errors are L2 norms over that of
the gradient. *Noise* is Mitsuba's own standard error, which is in every error; *direct* the error without transport.
What the default adds to the noise is the quadrature: *converged* has {fine[0]:,} directions, {samples}² samples, and
for bounces {fine[1]:,} patches in place of {patches:,}.

{beside}
"""


@dataclass
class TransportSettings:
    """conf/benchmark_transport.yaml. out: the page. vertices: the cup has more. rounds: of the clock."""

    out: str
    vertices: int
    rounds: int

    def __post_init__(self) -> None:
        require_range("vertices", self.vertices, 0, MOST_VERTICES)
        require_range("rounds", self.rounds, 1, MOST_ROUNDS)


def run(settings: TransportSettings) -> None:
    """Measure on one thread, and write the page."""
    out = writable_file(settings.out, "out")
    with mitsuba(DIFFERENTIABLE):
        pass  # a run without it would fail only at its end
    torch.set_num_threads(1)
    coarse, clock = normalise(solid("cup", 0)), Clock(torch.device("cpu"), settings.rounds)
    cup = subdivide(coarse, settings.vertices)
    text = TEXT.format(
        command=command_line(),
        machine=machine(clock.device),
        faces=len(cup.faces),
        vertices=len(cup.vertices),
        views=cost.VIEWS,
        costs=cost.costs(
            {name: cost.painted(cup, color) if color else cup for name, color in COLORS.items()}, SIZES, clock
        ),
        size=SIZES[0],
        converged=cost.CONVERGED,
        by_rays=cost.errors_by_rays(cup, SIZES[0]),
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
        beside=beside_mitsuba.table(),
    )
    write(out, joined([wrapped(text.strip())]))
