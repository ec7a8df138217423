"""The import rule that docs/architecture.md prints; sizes of files, packages and importers; the map of the rooms."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from acmr import records
from docs.rooms import PACKAGES, PICTURE, ROOT, draw, imports, module_of, modules, read_rule

PAGE = ROOT / "docs" / "architecture.md"
#: Modules of one package; a longer list is no map.
MOST_MODULES = 10
#: Modules of ours that one module may import; whoever needs more does the work of several.
MOST_IMPORTS = 15
#: Modules of ours that one of the analysis may import; what knows more than that should be told the rest.
MOST_IMPORTS = 15
#: Packages that may know Hydra; below them settings are plain dataclasses.
HYDRA_BORDER = ("acmr/settings", "acmr/app", "sweeps")
#: Importing these takes seconds, and reading results needs none of them.
HEAVY = {"torch", "wandb", "hydra", "omegaconf", "mujoco", "gymnasium"}


def sources(*packages: str) -> list[Path]:
    return [path for package in packages for path in sorted((ROOT / package).rglob("*.py"))]


MODULES = modules()


def literals(path: Path) -> set[str]:
    """Every string in a file's code; docstrings are left out."""
    tree = ast.parse(path.read_text())
    values = [node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)]
    return {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in values
    }


def part_of(module: str) -> str:
    """What the rule calls a module: its package below the top, or itself."""
    return module.split(".")[1]


def names(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", sources(*PACKAGES), ids=names)
def test_imports_go_down(path):
    package, _, below = module_of(path).partition(".")
    if not below or below.endswith("__main__"):
        return
    rule = read_rule(package)
    level_of = {part: index for index, level in enumerate(rule) for group in level for part in group}
    own = part_of(module_of(path))
    siblings = next(group for group in rule[level_of[own]] if own in group)
    for module in imports(path):
        if module.startswith(f"{package}."):
            other = part_of(module)
            assert other in siblings or level_of[other] < level_of[own], f"{module_of(path)} imports {module}"


def test_every_part_is_in_the_rule():
    for package in PACKAGES:
        parts = {part_of(module) for module in MODULES if module.startswith(f"{package}.")} - {"__main__"}
        assert parts == {part for level in read_rule(package) for group in level for part in group}


def test_the_analysis_takes_only_the_ground_of_acmr():
    ground = {f"acmr.{part}" for part in read_rule("acmr")[0][0]}
    for path in sources("analysis"):
        for module in imports(path):
            assert not module.startswith("acmr") or module in ground, path
            assert module.split(".")[0] not in HEAVY | {"sweeps"}, path


@pytest.mark.parametrize("path", sources("acmr"), ids=names)
def test_only_the_border_knows_hydra(path):
    tops = {module.split(".")[0] for module in imports(path)}
    assert not tops & {"analysis", "sweeps"} or names(path).startswith("acmr/app")
    if not names(path).startswith(HYDRA_BORDER):
        assert not tops & {"hydra", "omegaconf"}


def test_only_the_top_of_the_package_knows_where_users_come_in():
    importers = {module for module, path in MODULES.items() if any(n.startswith("acmr.app") for n in imports(path))}
    assert {module for module in importers if not module.startswith("acmr.app")} <= {"acmr", "acmr.__main__"}


def test_there_is_no_circle_and_nobody_imports_a_command_line():
    graph = {module: imports(path) & MODULES.keys() - {module} for module, path in MODULES.items()}
    # Raises CycleError with the circle.
    TopologicalSorter(graph).prepare()
    importers = [*MODULES.values(), *sources("tests", "bench")]
    assert not [path for path in importers if any(name.endswith("__main__") for name in imports(path))]


def test_the_files_of_a_run_and_its_states_are_named_in_records_only():
    files = {value for name, value in vars(records).items() if name.endswith("_FILE")}
    assert len(files) == 10
    for path in sources(*PACKAGES):
        if path == Path(records.__file__):
            continue
        for text in literals(path):
            assert not [name for name in files if name in text], f"{names(path)}: {text}"
            assert text not in (*records.ENDED, records.RUNNING), f"{names(path)}: {text}"


@pytest.mark.parametrize("module", MODULES)
def test_no_module_imports_too_many_of_ours(module):
    found = sorted(imports(MODULES[module]) & MODULES.keys() - {module})
    assert len(found) <= MOST_IMPORTS, f"{module} imports {len(found)}: {', '.join(found)}"


def test_no_package_has_too_many_modules():
    for package in {path.parent for path in MODULES.values()}:
        count = len([path for path in package.glob("*.py") if not path.name.startswith("__")])
        assert count <= MOST_MODULES, f"{names(package)}: {count} modules"


@pytest.mark.parametrize("path", sources("analysis"), ids=names)
def test_no_module_imports_too_many(path):
    assert len(imports(path) & MODULES.keys()) <= MOST_IMPORTS


@pytest.mark.parametrize("path", sources(*PACKAGES, "tests", "bench"), ids=names)
def test_no_file_is_longer_than_300_lines(path):
    assert len(path.read_text().splitlines()) <= 300


@pytest.mark.parametrize(
    ("heading", "most"), [("From the command line to the networks", 8), ("From env.step to Table 3", 10)]
)
def test_the_ways_through_the_code_are_short_and_there(heading, most):
    section = PAGE.read_text().split(f"## {heading}\n")[1].split("\n## ")[0]
    files = re.findall(r"^\d+\. `([^`]+)`", section, re.MULTILINE)
    assert 0 < len(files) <= most
    assert [file for file in files if not (ROOT / file).is_file()] == []


def test_the_picture_of_the_rooms_is_of_this_code():
    assert PICTURE.read_text() == draw(), "python -m docs.rooms draws it"
