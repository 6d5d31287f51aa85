"""The search of a scene: by name, or Newton's method, which no measured scene has a reason to leave."""

from pathlib import Path

import msgspec
import pytest

from tormagd.assembly.build import build_core, choose_solver
from tormagd.config import Config
from tormagd.inverse.bracketed import BracketedSearch
from tormagd.inverse.choice import RUNTIME_SOLVERS, build, named
from tormagd.inverse.nearest import NearestFieldSearch
from tormagd.inverse.newton import RisingSearch
from tormagd.model.model_file import ForceModel
from tormagd.physics.errors import DomainError
from tormagd.scenes.measured import measured
from tormagd.scenes.scene import Solver, load_scene, scene_path, shipped_scenes, terms_of
from tormagd_client.endpoints import ConfigError


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


@pytest.mark.parametrize("name", shipped_scenes())
def test_a_scene_gets_the_search_that_it_names_or_newton_where_there_is_one(name: str) -> None:
    scene = load_scene(name)
    built = build_core(Config(scene=name)).solver
    if scene.solver.name != "auto":
        assert built.solver == scene.solver.name
    elif "rate" in terms_of(scene).left_out:
        assert built.solver == "portrait"  # there is nothing to search
    else:
        assert built.solver == "newton"


def test_no_other_search_is_cheaper_or_more_exact_in_any_measured_scene() -> None:
    """Why nothing picks among them: on the device, by what `tools/required_terms.py --store` measured."""
    for scene in measured().scenes:
        found = {item.search: item for item in scene.searches}
        assert set(found) == set(RUNTIME_SOLVERS)
        newton = found.pop("newton")
        for other in found.values():
            assert scene.us_s(newton.cost) < scene.us_s(other.cost)
            assert newton.rms_N < other.rms_N + 0.01 * scene.tolerance_N


def test_a_scene_may_name_its_search() -> None:
    scene = load_scene(shipped_scenes()[0])
    wanted = msgspec.structs.replace(scene, solver=Solver(name="nearest", step_mT=5.0, neighbours=2))
    choice = choose_solver(wanted)
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
