"""Human dynamics: speed beside iDynTree, agreement with iDynTree and OpenSim on real recordings, consistency over seeds.

    OMP_NUM_THREADS=1 python benchmarks/human_dynamics_benchmark.py [--frames 1000] [--seeds 12] [--quick] [--data DATA_FOLDER]
    [--only speed,consistency,real] [--out benchmarks/results]

Every row has its value, its target and whether it is met. Peers: ``pip install idyntree opensim``; rows of a peer that is not here are "not
measured", which fails their target. Exit code 1 when a target is missed. About ten minutes; ``--quick`` one.

Limits: one machine; random motion for the times; simulated noise is white, and models make no errors, in the rows of consistency.
"""

from __future__ import annotations

import argparse
import json
import sys
from functools import partial
from pathlib import Path

from human_dynamics_real import real
from human_dynamics_speed import speed
from metrics import Metric, metric_table, missed

from factorgrasp.atomic import write_text
from factorgrasp.simulation.human_dynamics import HANDS, HumanNoise, human_bowing, human_carrying, human_tpose
from factorgrasp.simulation.human_dynamics_consistency import monte_carlo, two_tasks_and_joint
from factorgrasp.solvers.measure import environment

PACKAGES = ("numpy", "scipy", "numba", "qdldl", "pin", "piqp", "idyntree", "opensim")
PARTS = ("speed", "consistency", "real")


def consistency(seeds: int) -> list[Metric]:
    """NEES per degree of freedom in independent frames, in the plain 95 % band, with poses taken to be exact beside it."""
    # Walking has more bandwidth than 6 Hz: what the filter takes off would count as an error.
    fast = HumanNoise(bandwidth=9.0)
    cases = {
        "T-pose": (human_tpose, ()),
        "T-pose, 5 kg": (partial(human_tpose, payload=5.0), ("RightHand",)),
        "bowing": (human_bowing, ()),
        "carrying 9.55 kg, standing": (human_carrying, HANDS),
        "walking": (partial(human_carrying, motion="walking", payload=0.0, noise=fast), ()),
    }
    out = []
    for name, (make, hands) in cases.items():
        exact = monte_carlo(make, range(min(seeds, 3)), hands, state_noise=False)
        kinds = dict(monte_carlo(make, range(seeds), hands))
        if hands:
            # One number a frame: it takes more frames for as narrow a band.
            kinds["payload"] = monte_carlo(make, range(5 * seeds), hands, model=1e-6)["payload"]
        for what, found in kinds.items():
            note = f"{found.dof} degrees of freedom; {exact[what].ratio:.3g} with poses taken to be exact"
            out.append(Metric(f"NEES/{name}, {what}", found.ratio, "", "within", found.band, note))
            print(f"  {out[-1].key}: {found.ratio:.4f}", flush=True)
    for method, (rms, sd, nees) in two_tasks_and_joint(
        cases["T-pose, 5 kg"][0], range(min(seeds, 4)), ("RightHand",)
    ).items():
        note = f"stated sd {sd:.3f} Nm RMS; NEES per degree of freedom {nees:.3g}"
        out.append(Metric(f"T-pose, 5 kg, {method}/RMS error of torques", rms, "Nm", note=note))
    return out


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--quick", action="store_true", help="300 frames, one seed")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--only", default=",".join(PARTS))
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    wanted = arguments.only.split(",")
    if unknown := set(wanted) - set(PARTS):
        parser.error(f"--only: parts among {', '.join(PARTS)}, not {', '.join(sorted(unknown))}")
    frames, seeds = (300, 1) if arguments.quick else (arguments.frames, arguments.seeds)
    metrics: list[Metric] = []
    if "speed" in wanted:
        metrics += speed(frames)
    if "real" in wanted:
        metrics += real(arguments.data)
    if "consistency" in wanted:
        metrics += consistency(seeds)
    machine = environment(PACKAGES)
    notes = (", ".join(f"{name} {words}" for name, words in machine.items()),)
    print(metric_table(metrics, "Human dynamics", notes).text())
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        write_text(
            arguments.out / "human_dynamics_benchmark.md",
            metric_table(metrics, "Human dynamics", notes).markdown(),
        )
        found = {"machine": machine, "metrics": [metric.to_dict() for metric in metrics]}
        write_text(arguments.out / "human_dynamics_benchmark.json", json.dumps(found, indent=1))
    return 1 if missed(metrics) else 0


if __name__ == "__main__":
    sys.exit(main())
