"""Range of motion of a wrist from unlabelled blobs.

Run it with a problem file, or without any to see it work on a simulated recording:

    python examples/wrist_range_of_motion.py wrist.toml
"""

from __future__ import annotations

import sys
import tempfile

import numpy as np

from factorgrasp.problem_file import load_problem

if len(sys.argv) == 2:
    file = sys.argv[1]
else:
    from factorgrasp.simulation.wrist import cordella2014
    from factorgrasp.simulation.wrist_files import write_wrist_recording

    file = str(write_wrist_recording(cordella2014(motion="abduction", duration=6.0), tempfile.mkdtemp()))

result = load_problem(file).solve()
print(result.summary())
for one in result.measures.range_of_motion:
    low, high = np.degrees(one.range.interval)
    print(f"{one.axis}: {np.degrees(one.range.value):.1f} deg, 95 % interval {low:.1f} to {high:.1f}")
