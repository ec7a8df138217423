"""What a run says of where it was made."""

import platform
import shutil
import subprocess

import pytest

from acmr.run.reproducibility import machine


@pytest.mark.skipif(shutil.which("lscpu") is None, reason="no lscpu here to compare with")
def test_the_processor_is_the_one_that_lscpu_knows():
    said = subprocess.run(["lscpu"], capture_output=True, text=True, check=True, env={"LC_ALL": "C"}).stdout
    known = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in said.splitlines())}
    here = machine(1, "cpu")
    if platform.machine() == "x86_64":
        kind = f" (family {known['CPU family']}, model {known['Model']})"
        assert here["processor"] == known["Model name"] + kind
    assert (here["threads"], here["device"]) == (1, "cpu")
