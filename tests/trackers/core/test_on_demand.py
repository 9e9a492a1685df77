"""Names that are imported when first used: none of the heavy packages before, the same objects as from their modules after."""

from __future__ import annotations

import subprocess
import sys

import trackwright
from trackwright import sim
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
    assert {name for name in dir(trackwright) if not name.startswith("__")} == set(trackwright.__all__)
