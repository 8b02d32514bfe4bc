"""The closed loop: an arm that holds an object with a human finds out where the human holds, and hardly pulls at the wrist.

Beside it the paper's procedure (Cehajic 2015, law (26) fed with its own moving estimate) on the same noise.
"""

from __future__ import annotations

import numpy as np

from factorgrasp.simulation.cehajic2015_loop import cehajic2015_loop

for policy, arm in (("receding", True), ("velocity", False)):
    run = cehajic2015_loop(seed=0, policy=policy, arm=arm, duration=6.0)
    felt = run.felt()
    print(
        f"{policy:>9}: {np.degrees(run.rotation_error[-1]):6.3f} deg and {1e3 * run.translation_error[-1]:7.2f} mm off; "
        f"the wrist felt {felt.peak_force:6.2f} N at most, {felt.rms_force:6.2f} N RMS"
    )
