"""Imports only go down (docs/architecture.md), and each file stays readable."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
#: Each floor may import the floors below it; within a floor, only what is listed.
FLOORS = [
    {"config", "seeding", "records", "durable", "provenance", "heartbeat", "stopping"},
    {"run_dir", "networks", "matmul", "envs", "wandb_backend", "progress"},
    {"checkpoint", "replay_buffer", "learner", "tracking", "snapshots", "fingerprint", "camera"},
    {"transfer", "sac", "mirror", "video", "segments"},
    {"trainer", "recorder", "compose", "rollout", "disk"},
    {"identity", "messages", "run_state", "evaluation"},
    {"preparation", "summary", "resume"},
    {"experiment"},
]
HYDRA_BORDER = {"compose", "messages"}
PACKAGES = ("acmr", "analysis", "sweeps")


def modules(package: str) -> dict[str, Path]:
    """Module name below the package (``envs`` for all of a subpackage) by file."""
    folder = ROOT / package
    return {str(path.relative_to(ROOT)): path for path in sorted(folder.rglob("*.py"))}


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


def floor_of(name: str) -> int:
    floors = [index for index, members in enumerate(FLOORS) if name in members]
    assert floors, f"acmr/{name} stands on no floor of tests/test_architecture.py"
    return floors[0]


ACMR = [path for path in modules("acmr").values() if path.name != "__init__.py" or path.parent.name != "acmr"]


@pytest.mark.parametrize("path", ACMR, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_down(path):
    part = path.relative_to(ROOT / "acmr").parts[0].removesuffix(".py")
    floor = floor_of(part)
    for module in imports(path):
        if module.startswith("acmr."):
            other = module.split(".")[1]
            if other != part:
                assert floor_of(other) < floor, f"{part} (floor {floor}) imports {other} (floor {floor_of(other)})"


@pytest.mark.parametrize("path", ACMR, ids=lambda path: str(path.relative_to(ROOT)))
def test_only_the_border_knows_hydra(path):
    tops = {module.split(".")[0] for module in imports(path)}
    if path.stem not in HYDRA_BORDER:
        assert not tops & {"hydra", "omegaconf"}
    assert not tops & {"analysis", "sweeps"}


def test_analysis_needs_neither_torch_nor_wandb():
    for path in modules("analysis").values():
        for module in imports(path):
            assert module.split(".")[0] not in ("torch", "wandb", "hydra", "omegaconf", "mujoco", "sweeps"), path
            assert not module.startswith("acmr") or module == "acmr.records", path


@pytest.mark.parametrize(
    "path",
    [path for package in (*PACKAGES, "tests", "bench") for path in modules(package).values()],
    ids=lambda path: str(path.relative_to(ROOT)),
)
def test_no_file_is_longer_than_300_lines(path):
    assert len(path.read_text().splitlines()) <= 300
