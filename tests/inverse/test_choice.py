"""Choosing a search: by tolerance from a table, by name, from the committed table for every shipped scene."""

import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from tormagd.config import Config, ConfigError
from tormagd.control.core import build_core, choose_solver
from tormagd.inverse.bracketed import BracketedSearch
from tormagd.inverse.choice import RUNTIME_SOLVERS, SAME_TIME, Variant, build, choose, named, solver_table
from tormagd.inverse.nearest import NearestFieldSearch
from tormagd.inverse.newton import RisingSearch
from tormagd.model.model_file import ForceModel
from tormagd.physics.errors import DomainError
from tormagd.scenes.scene import Solver, load_scene, scene_path, shipped_scenes, terms_of


def variant(solver: str, p50_us: float, force_max_N: float, hidden: int = 50, step_mT: float = 20.0) -> Variant:
    return Variant(
        solver=solver,
        step_mT=step_mT,
        neighbours=4,
        dtype="float64",
        hidden=hidden,
        p50_us=p50_us,
        solver_force_max_N=force_max_N,
    )


TABLE = (
    variant("nearest", 10.0, 1e-2),
    variant("coarse-to-fine", 20.0, 1e-3),
    variant("newton", 30.0, 1e-9),
    variant("newton", 300.0, 1e-9, hidden=200),
)


@pytest.mark.parametrize(
    ("tolerance_N", "expected"),
    [(0.1, "nearest"), (0.099, "coarse-to-fine"), (0.01, "coarse-to-fine"), (1e-3, "newton")],
)
def test_the_cheapest_within_a_tenth_of_the_tolerance(tolerance_N: float, expected: str) -> None:
    assert choose(TABLE, tolerance_N, hidden=50).solver == expected


def test_where_none_is_accurate_enough_the_best_is_taken_and_the_reason_says_so() -> None:
    choice = choose(TABLE, 1e-12, hidden=50)
    assert choice.solver == "newton"
    assert "outside" in choice.reason
    assert "within" in choose(TABLE, 0.1, hidden=50).reason


def test_rows_of_the_next_larger_network_count() -> None:
    table = (*TABLE, variant("nearest", 100.0, 1e-9, hidden=100))
    assert choose(table, 0.1, hidden=51).solver == "nearest"
    assert choose(table, 0.1, hidden=200).solver == "newton"
    assert choose(table, 0.1, hidden=4096).solver == "newton"


def test_among_equally_fast_searches_the_more_accurate_is_taken() -> None:
    table = (variant("nearest", 20.0, 1e-3), variant("newton", 20.0 * SAME_TIME, 1e-9))
    assert choose(table, 0.1, hidden=50).solver == "newton"
    table = (variant("nearest", 20.0, 1e-3), variant("newton", 20.1 * SAME_TIME, 1e-9))
    assert choose(table, 0.1, hidden=50).solver == "nearest"


def test_searches_that_the_daemon_cannot_run_are_never_chosen() -> None:
    assert choose((*TABLE, variant("brent", 1.0, 0.0), variant("direct", 0.1, 0.0)), 0.1, 50).solver == "nearest"
    with pytest.raises(DomainError, match="no rows"):
        choose((variant("brent", 1.0, 0.0),), 0.1, 50)


@pytest.mark.parametrize("name", RUNTIME_SOLVERS)
def test_a_named_search_is_built_with_its_settings(rising: ForceModel, name: str) -> None:
    for rises in (False, True):
        built = build(named(name, step_mT=25.0), (100.0, 800.0), rises=rises)
        newton = RisingSearch if rises else BracketedSearch
        expected = {"nearest": NearestFieldSearch, "coarse-to-fine": BracketedSearch, "newton": newton}
        assert isinstance(built, expected[name])
        usual = build(named(name), (100.0, 800.0), rises=rises)
        assert usual.solve(rising.curve(0.5, 10, 40.0), 3.0, None).field_mT > 100


def test_a_name_that_is_none_is_refused_with_those_that_are() -> None:
    with pytest.raises(DomainError, match=r"solver\.name = 'bisection'.*nearest, coarse-to-fine, newton"):
        named("bisection")


def test_the_committed_table_serves_every_size() -> None:
    table = solver_table()
    assert {row.solver for row in table} == set(RUNTIME_SOLVERS)
    assert min(row.hidden for row in table) <= 10
    assert max(row.hidden for row in table) >= 200
    assert all(row.p50_us > 0 and row.solver_force_max_N >= 0 for row in table)


@pytest.mark.parametrize("name", shipped_scenes())
def test_a_shipped_scene_gets_a_search_within_its_tolerance(name: str) -> None:
    """By the table; one that names its search gets that."""
    scene = load_scene(name)
    choice = choose(solver_table(), scene.force.tolerance_rms_N, hidden=50)
    assert choice.reason.startswith("the cheapest within")
    built = build_core(Config(scene=name)).solver
    if scene.solver.name != "auto":
        assert built.solver == scene.solver.name
    elif "rate" in terms_of(scene).left_out:
        assert built.solver == "portrait"  # there is nothing to search
    else:
        assert built == choice


def test_a_scene_may_name_its_search() -> None:
    scene = load_scene(shipped_scenes()[0])
    wanted = msgspec.structs.replace(scene, solver=Solver(name="nearest", step_mT=5.0, neighbours=2))
    choice = choose_solver(wanted, hidden=50)
    assert (choice.solver, choice.step_mT, choice.neighbours) == ("nearest", 5.0, 2)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('name = "bisection"', ("solver.name", "bisection", "newton")),
        ("step_mT = 5.0", ("solver.step_mT", "5.0", "auto")),
        ('name = "nearest"\nneighbours = 60\nstep_mT = 50.0', ("neighbours", "60", "number of grid points")),
    ],
)
def test_a_scene_whose_search_cannot_be_is_refused(tmp_path: Path, table: str, words: tuple[str, ...]) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(Path(scene_path("coronary")).read_text() + f"\n[solver]\n{table}\n")
    with pytest.raises(ConfigError) as caught:
        build_core(Config(scene=str(path)))
    assert all(word in str(caught.value) for word in words)


def test_what_trains_and_what_is_for_the_laboratory_stays_out_of_the_daemon() -> None:
    """torch takes seconds to load, and the searches that the daemon may run know nothing but a curve."""
    loaded = "import sys, tormagd.control.core, tormagd.inverse.choice; print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", loaded], check=True, capture_output=True, text=True).stdout.split()
    assert "tormagd.inverse.newton" in found
    assert not {"torch", "scipy", "sklearn", "matplotlib"} & set(found)
