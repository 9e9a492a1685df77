"""Names that are imported when first used: none of the heavy packages before, the same objects as from their modules after."""

from __future__ import annotations

import pkgutil
import subprocess
import sys

import pytest

import trackwright
from trackwright import sim, tuning
from trackwright.tuning.fitting import fit


def test_importing_the_package_and_reading_a_folder_import_no_jax(tmp_path):
    program = (
        "import sys, trackwright as tw\n"
        "try: tw.read('nowhere')\n"
        "except tw.UnusableInput: pass\n"
        "print([name for name in ('jax', 'scipy', 'matplotlib') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_name_is_the_object_of_its_module_and_dir_lists_it():
    assert trackwright.fit is fit
    assert trackwright.simulate is sim.worlds
    assert {"fit", "simulate", "read", "__version__"} <= set(dir(trackwright))


@pytest.mark.parametrize("package", [sim, tuning, trackwright], ids=lambda p: p.__name__)
def test_an_unknown_name_is_an_attribute_error(package):
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = package.nothing


@pytest.mark.parametrize("package", [sim, tuning], ids=lambda p: p.__name__)
def test_no_public_name_is_that_of_a_module_which_an_import_would_set_in_its_place(package):
    modules = {module.name for module in pkgutil.iter_modules(package.__path__)}
    assert not modules & set(package.__all__)


def test_a_misspelt_name_is_answered_with_the_nearest_one():
    with pytest.raises(AttributeError, match=r"no attribute 'evalute' \(did you mean evaluate\?\)"):
        trackwright.evalute  # noqa: B018
