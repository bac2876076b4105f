"""The targets, each with what this run measured."""

from collections.abc import Sequence

from renderer.cache import OperatorCache
from renderer.mesh import Mesh
from train.report.tables import shown
from train.studies.renderer_speed import comparison, mitsuba_peer
from train.studies.renderer_speed.bench import SAMPLES, Bench
from train.studies.renderer_speed.results import Row, times
from train.studies.renderer_speed.skipping import build_operators
from train.studies.renderer_speed.steps import light_step, vertex_step
from train.studies.targets import Target


def by_light(small: Sequence[Row], large: Sequence[Row]) -> list[Target]:
    """Of panels of `comparison` at the two sizes."""
    asked = {comparison.BY_FACE_KEPT: (10, 30), mitsuba_peer.NAME: (300, 400)}
    panels = [{row.setting: row for row in rows} for rows in (large, small)]
    return [
        _faster(rows, comparison.OPERATOR, peer, least)
        for peer, each in asked.items()
        for rows, least in zip(panels, each, strict=True)
    ]


def by_vertices(rows: Sequence[Row]) -> list[Target]:
    """Of a panel of `comparison`."""
    named = {row.setting: row for row in rows}
    return [
        _faster(named, comparison.rasterised(comparison.ANALYTIC, 1), mitsuba_peer.NAME, 30),
        *(
            _faster(named, comparison.rasterised(comparison.ANALYTIC, samples), comparison.rasterised(peer, samples), 3)
            for peer in (comparison.BY_SAMPLE, comparison.BY_FACE)
            for samples in (comparison.COARSER, 1)
        ),
    ]


def _faster(rows: dict[str, Row], ours: str, theirs: str, least: float) -> Target:
    """Beside the ratio, for Mitsuba: no larger an error of the image and of the gradient."""
    own, other = rows[ours], rows.get(theirs)
    what, asked = f"{own.panel}: {ours}, against {theirs}", f"at least {least}× faster"
    if other is None:
        return Target(what, asked, "not measured", None)
    ratio = other.time_ms / own.time_ms
    if theirs != mitsuba_peer.NAME:
        return Target(what, asked, times(ratio), ratio >= least)
    errors = [(row.image_error or 0.0, row.gradient_error or 0.0) for row in (own, other)]
    accurate = all(our <= their for our, their in zip(*errors, strict=True))
    mine, its = (" and ".join(map(shown, pair)) for pair in errors)
    found = f"{times(ratio)}, errors of image and gradient {mine} against {its}"
    return Target(what, f"{asked}, error no larger", found, ratio >= least and accurate)


def measured(bench: Bench, meshes: Sequence[Mesh]) -> list[Target]:
    """Those that need timings of their own. meshes: of the scene whose operators are built."""
    return [_any_mesh(bench), *_geometry(bench), _building(bench, meshes)]


def _any_mesh(bench: Bench) -> Target:
    counts = bench.plan.mesh, bench.plan.vertices[-1]
    views = {count: bench.view(count, bench.plan.large) for count in counts}
    steps = {
        count: light_step(view, view.operator(bench.plan.workload_samples), bench.light())
        for count, view in views.items()
    }
    ms = bench.clock.medians(steps, 3 * bench.clock.rounds)
    ratio = ms[counts[1]] / ms[counts[0]]
    what = f"light step, {bench.plan.large}²: {counts[1]:,} vertices against {counts[0]:,}"
    return Target(what, "within 10 %", f"{100 * (ratio - 1):+.1f} %", abs(ratio - 1) <= 0.1)


def _geometry(bench: Bench) -> list[Target]:
    view, light = bench.view(bench.plan.mesh, bench.plan.large), bench.light()
    steps = {
        "light": light_step(view, view.operator(1), light),
        comparison.KEPT: vertex_step(view, 1, light, kept=True),
        comparison.REFRESHED: vertex_step(view, 1, light),
    }
    ms = bench.clock.medians(steps, 3 * bench.clock.rounds)
    targets = []
    for visibility, most in ((comparison.KEPT, 8), (comparison.REFRESHED, 14)):
        ratio = ms[visibility] / ms["light"]
        found = f"{times(ratio)}, {shown(ms[visibility])} ms against {shown(ms['light'])} ms"
        what = f"vertex step against light step, {view.size}², {visibility}"
        targets.append(Target(what, f"at most {most}×", found, ratio <= most))
    return targets


def _building(bench: Bench, meshes: Sequence[Mesh]) -> Target:
    rounds = max(1, bench.clock.rounds // 3)
    ms = bench.clock.medians({"build": lambda: build_operators(bench, meshes, OperatorCache())}, rounds)
    faces, seconds = " and ".join(f"{len(mesh.faces):,}" for mesh in meshes), ms["build"] / 1e3
    views, size = len(meshes) * bench.plan.views, bench.plan.small
    what = f"operators of {views} views, {size}², {SAMPLES}² samples, meshes of {faces} faces"
    return Target(what, "under 1.5 s", f"{shown(seconds)} s", seconds < 1.5)
