#!/usr/bin/env python3
"""Compares `odograph evaluate` with evo (github.com/MichaelGrupp/evo) on the same files.

    python3 -m venv /tmp/evo && /tmp/evo/bin/pip install evo==1.38.1
    cargo build --release
    /tmp/evo/bin/python bench/compare_evo.py target/release/odograph

Generates trajectories with a fixed seed, evaluates each pair of files with both programs in all
settings that both support, and prints the maximum difference of each. Exits with code 1 if one
exceeds 1e-9 (relative for values above 1).
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from evo.core import geometry, metrics, sync
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

LIMIT = 1e-9
Z = np.array([0.0, 0.0, 1.0])
NADIR = Rotation.from_matrix([[0, -1, 0], [-1, 0, 0], [0, 0, -1]])


def planar(times, radius=3.0):
    """A camera 1 m above a figure eight, looking down."""
    phase = 0.2 * times
    xyz = np.stack([radius * np.sin(phase), radius * np.sin(phase) * np.cos(phase), np.full_like(phase, 1.0)], axis=1)
    return xyz, Rotation.from_rotvec(phase[:, None] * Z) * NADIR


def spatial(times):
    """A camera with arbitrary motion in six degrees of freedom."""
    xyz = np.stack([8 * np.sin(0.3 * times), 5 * np.cos(0.21 * times), 2 * np.sin(0.5 * times) + 0.1 * times], axis=1)
    return xyz, Rotation.from_rotvec(np.stack([np.sin(0.3 * times), 0.4 * times, np.cos(0.7 * times)], axis=1))


def straight(times):
    xyz = np.stack([0.5 * times, 0 * times, 0 * times + 1], axis=1)
    return xyz, Rotation.from_rotvec(0 * times[:, None] * Z) * NADIR


def disturbed(random, xyz, rotation, noise_m, noise_rad, scale=1.0, moved=True):
    """Adds noise, slow drift, another scale and another world frame."""
    count = len(xyz)
    drift = np.cumsum(random.normal(0, noise_m * 0.2, (count, 3)), axis=0)
    xyz = scale * (xyz + random.normal(0, noise_m, (count, 3)) + drift)
    rotation = rotation * Rotation.from_rotvec(random.normal(0, noise_rad, (count, 3)))
    if moved:
        world = Rotation.from_rotvec([0.3, -0.8, 2.0])
        xyz, rotation = world.apply(xyz) + [4.0, -7.0, 2.5], world * rotation
    return xyz, rotation


def write_tum(path, times, xyz, rotation):
    rows = np.column_stack([times, xyz, rotation.as_quat()])
    np.savetxt(path, rows, fmt=["%.9f"] + ["%.17g"] * 7, header="time x y z qx qy qz qw")


def write_kitti(path, xyz, rotation):
    np.savetxt(path, np.concatenate([rotation.as_matrix(), xyz[:, :, None]], axis=2).reshape(-1, 12), fmt="%.17g")


def cases(folder):
    """Name, estimate file, truth file, maximum time difference, whether evo can align."""
    random = np.random.default_rng(20260101)
    fast, slow = np.arange(0, 40, 1 / 100), np.arange(0.003, 39, 1 / 30)
    epoch = 1403636579.75

    def case(name, times, path, truth_times, change, max_difference=0.01):
        write_tum(folder / f"{name}.truth.tum", truth_times, *path(truth_times % epoch))
        keep = change.pop("keep", np.ones(len(times), bool))
        write_tum(folder / f"{name}.tum", times[keep], *disturbed(random, *(v[keep] for v in path(times % epoch)), **change))
        return name, folder / f"{name}.tum", folder / f"{name}.truth.tum", max_difference

    gap = (slow < 12) | (slow > 19)
    yield case("planar", slow, planar, slow, dict(noise_m=0.01, noise_rad=0.01))
    yield case("planar_same_world", slow, planar, fast, dict(noise_m=0.005, noise_rad=0.002, moved=False))
    yield case("planar_scaled", slow, planar, fast, dict(noise_m=0.02, noise_rad=0.01, scale=1.7))
    yield case("spatial", fast, spatial, fast, dict(noise_m=0.05, noise_rad=0.02))
    yield case("spatial_faster_estimate", fast, spatial, slow, dict(noise_m=0.03, noise_rad=0.05, scale=0.2))
    yield case("gaps", slow, planar, fast, dict(noise_m=0.01, noise_rad=0.01, keep=gap))
    jitter = slow + random.uniform(-0.012, 0.012, len(slow))
    yield case("jittered_times", jitter, spatial, slow, dict(noise_m=0.01, noise_rad=0.01))
    yield case("coarse", slow, spatial, np.arange(0, 40, 0.5), dict(noise_m=0.01, noise_rad=0.01), 0.02)
    yield case("epoch_times", slow + epoch, spatial, fast + epoch, dict(noise_m=0.01, noise_rad=0.01))
    yield case("straight", slow, straight, slow, dict(noise_m=0.002, noise_rad=0.001))
    yield case("tiny_errors", slow, planar, slow, dict(noise_m=1e-7, noise_rad=1e-7))
    write_kitti(folder / "kitti.truth.txt", *spatial(slow))
    write_kitti(folder / "kitti.txt", *disturbed(random, *spatial(slow), noise_m=0.05, noise_rad=0.02))
    yield "kitti", folder / "kitti.txt", folder / "kitti.truth.txt", 0.01


def evo_pair(estimate, truth, max_difference):
    if estimate.suffix == ".tum":
        loaded = [file_interface.read_tum_trajectory_file(p) for p in (truth, estimate)]
        return sync.associate_trajectories(*loaded, max_diff=max_difference)
    return tuple(file_interface.read_kitti_poses_file(p) for p in (truth, estimate))


def align(kind, truth, estimate):
    if kind in ("se3", "sim3"):
        estimate.align(truth, correct_scale=kind == "sim3")
    elif kind == "origin":
        estimate.align_origin(truth)
    elif kind == "se2":
        # evo has no such setting; it is equivalent to its Umeyama alignment in two dimensions.
        turn, shift, _ = geometry.umeyama_alignment(estimate.positions_xyz[:, :2].T, truth.positions_xyz[:, :2].T)
        movement = np.eye(4)
        movement[:2, :2], movement[:2, 3] = turn, shift
        estimate.transform(movement)


def statistics(metric, truth, estimate):
    metric.process_data((truth, estimate))
    return metric.get_all_statistics()


def difference(ours, theirs):
    return max(abs(ours[name] - value) / max(1.0, abs(value)) for name, value in theirs.items())


def main():
    program = sys.argv[1] if len(sys.argv) > 1 else "target/release/odograph"
    translation, rotation = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad
    worst, compared = 0.0, 0
    with tempfile.TemporaryDirectory() as folder:
        print(f"{'case':<26}{'alignment':<10}{'poses':>6}{'ATE (m)':>12}   largest difference: ATE, RPE")
        for name, estimate_file, truth_file, max_difference in cases(Path(folder)):
            for kind in ("none", "origin", "se2", "se3", "sim3"):
                truth, estimate = evo_pair(estimate_file, truth_file, max_difference)
                try:
                    align(kind, truth, estimate)
                except geometry.GeometryException as refusal:
                    print(f"{name:<26}{kind:<10}{estimate.num_poses:>6}{'':>12}   evo refuses: {refusal}")
                    continue
                off = {"ate": 0.0, "rpe": 0.0}
                for all_pairs in (False, True):
                    command = [program, "evaluate", estimate_file, truth_file, "--json", "--align", kind, "--delta", "1f,7f,0.5m,2m"]
                    command += ["--max-time-difference", str(max_difference)] + ["--all-pairs"] * all_pairs
                    ours = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
                    assert ours["compared_poses"] == estimate.num_poses, (name, ours["compared_poses"], estimate.num_poses)
                    for key, relation in (("translation_m", translation), ("rotation_rad", rotation)):
                        ape = statistics(metrics.APE(relation), truth, estimate)
                        off["ate"] = max(off["ate"], difference(ours["absolute"][key], ape))
                        compared += len(ape)
                        for relative in ours["relative"]:
                            unit = {"m": metrics.Unit.meters, "frames": metrics.Unit.frames}[relative["delta_unit"]]
                            metric = metrics.RPE(relation, relative["delta"], unit, all_pairs=all_pairs)
                            rpe = statistics(metric, truth, estimate)
                            assert relative[key]["count"] == len(metric.error), (name, kind, relative["delta"])
                            off["rpe"] = max(off["rpe"], difference(relative[key], rpe))
                            compared += len(rpe)
                ate = ours["absolute"]["translation_m"]["rmse"]
                print(f"{name:<26}{kind:<10}{estimate.num_poses:>6}{ate:>12.6f}   {off['ate']:.1e} {off['rpe']:.1e}")
                worst = max(worst, *off.values())
    print(f"{compared} figures compared; the largest difference is {worst:.1e}, the limit {LIMIT:.0e}")
    return int(worst > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
