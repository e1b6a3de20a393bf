"""Cairn and Open3D on the same pairs of real scans: CPU time, recall and precision, as one table.

    pip install open3d
    cargo build --release
    python benches/open3d/compare.py --cairn target/release/cairn SCENE...

A SCENE is a folder of the 3DMatch benchmark: `scans/*.ply`, `poses.json` ({file name: 4x4 matrix, scan to world}), and
`3DMatch_gt.log` and `3DLoMatch_gt.log` with their `.info` files, whose scan i is the file `cloud_bin_i.ply`. From each scene come 20
scans, spread evenly over it, and of them equally many pairs with overlap (as far as there are, half of them from either log) and
without (in no log, and no part of one near the other by the true poses): as in a survey, a scan is in several pairs. The
choice is the same on every machine.

Open3D runs as its documentation has it: voxels of 5 cm, normals from 10 cm, FPFH from 25 cm, RANSAC on mutual matches within 7.5 cm, then
point-to-plane ICP. Two things are done in its favour: normals are turned to the sensor, which its tutorial leaves out, and
of all thresholds on the fitness after ICP the one is reported that is best on these very pairs. Cairn runs with its defaults and
accepts what it says is likelier right than wrong.

CPU time is user and system time of all threads: of a scan from the file to its features, which are made once, and of a pair from there to
its pose.
"""

import argparse
import json
import pathlib
import resource
import subprocess
import sys
import tempfile
import time

import numpy as np
import open3d as o3d

VOXEL = 0.05
SCANS = 20
RIGHT_DEG, RIGHT_M, RIGHT_RMSE_M = 15.0, 0.3, 0.2
LOGS = ("3DMatch", "3DLoMatch")


def blocks(path, rows):
    """The (i, j, matrix) of a log (4 rows) or info file (6 rows)."""
    lines = [line.split() for line in path.read_text().splitlines() if line.strip()]
    for at in range(0, len(lines), rows + 1):
        yield int(lines[at][0]), int(lines[at][1]), np.array(lines[at + 1 : at + 1 + rows], float)


class Scene:
    """Scans of a scene, the pairs of its logs, and its true poses."""

    def __init__(self, folder):
        self.folder, self.name = folder, folder.resolve().name
        self.poses = {name: np.array(pose) for name, pose in json.loads((folder / "poses.json").read_text()).items()}
        self.logs, self.weights, self.truth = [], {}, {}
        for log in LOGS:
            found = list(blocks(folder / f"{log}_gt.log", 4))
            self.logs.append([(i, j) for i, j, _ in found])
            self.truth.update({(i, j): pose for i, j, pose in found})
            self.weights.update({(i, j): weight for i, j, weight in blocks(folder / f"{log}_gt.info", 6)})

    def file(self, scan):
        return f"cloud_bin_{scan}.ply"

    def path(self, scan):
        return self.folder / "scans" / self.file(scan)

    def a_from_b(self, i, j):
        """The truth about a pair."""
        if (i, j) in self.truth:
            return self.truth[i, j]
        return np.linalg.inv(self.poses[self.file(i)]) @ self.poses[self.file(j)]

    def choose(self, count):
        """As many pairs with overlap as without: [(i, j, whether they overlap)]."""
        scans = spread(range(len(self.poses)), SCANS)
        chosen = []
        for share, log in zip((count // 4, count // 2 - count // 4), self.logs):
            inside = {(i, j) for i, j in log if i in scans and j in scans}
            chosen += [(*pair, True) for pair in spread(sorted(inside - {c[:2] for c in chosen}), share)]
        apart = [(i, j) for i in scans for j in scans if i < j and (i, j) not in self.truth]
        clouds = {}
        # In a fixed order that jumps through the list, until enough are found that really have nothing in common.
        step = next(s for s in range(int(0.618 * len(apart)), 0, -1) if np.gcd(s, len(apart)) == 1)
        at = 0
        for _ in apart:
            if len(chosen) == count:
                break
            at = (at + step) % len(apart)
            if not self.overlap(*apart[at], clouds):
                chosen.append((*apart[at], False))
        return chosen

    def overlap(self, i, j, clouds):
        """Whether any part of one scan, beyond a few stray points, is near the other by the true poses."""
        for scan in (i, j):
            if scan not in clouds:
                cloud = o3d.io.read_point_cloud(str(self.path(scan))).voxel_down_sample(2 * VOXEL)
                clouds[scan] = cloud.transform(self.poses[self.file(scan)])
        distances = np.asarray(clouds[i].compute_point_cloud_distance(clouds[j]))
        return (distances < 3 * VOXEL).mean() > 0.01


def spread(pairs, count):
    """`count` of the pairs, evenly spread over them."""
    return [pairs[k * len(pairs) // count] for k in range(min(count, len(pairs)))]


def errors(estimate, truth):
    """Angle in degrees, distance in metres."""
    delta = np.linalg.inv(truth) @ estimate
    cosine = np.clip((np.trace(delta[:3, :3]) - 1) / 2, -1, 1)
    return np.degrees(np.arccos(cosine)), np.linalg.norm(delta[:3, 3])


def within_rmse(estimate, truth, weight):
    """The benchmark's rule: root mean square distance of the true correspondences, from their information matrix."""
    delta = np.linalg.inv(truth) @ estimate
    w = np.sqrt(max(1 + np.trace(delta[:3, :3]), 1e-12)) / 2
    r = delta[:3, :3]
    xi = np.r_[delta[:3, 3], np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (4 * w)]
    return xi @ weight @ xi / weight[0, 0] <= RIGHT_RMSE_M**2


def run_open3d(scenes, pairs):
    """[(pose, fitness)], and CPU seconds of features and of pairs."""
    registration = o3d.pipelines.registration
    started = time.process_time()
    ready, results = {}, []

    def features(scene, scan):
        if (scene.name, scan) not in ready:
            cloud = o3d.io.read_point_cloud(str(scene.path(scan))).voxel_down_sample(VOXEL)
            cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2 * VOXEL, max_nn=30))
            cloud.orient_normals_towards_camera_location(np.zeros(3))
            search = o3d.geometry.KDTreeSearchParamHybrid(radius=5 * VOXEL, max_nn=100)
            ready[scene.name, scan] = cloud, registration.compute_fpfh_feature(cloud, search)
        return ready[scene.name, scan]

    for scene, i, j, _ in pairs:
        features(scene, i), features(scene, j)
    featured = time.process_time()
    for number, (scene, i, j, _) in enumerate(pairs):
        (a, features_a), (b, features_b) = features(scene, i), features(scene, j)
        o3d.utility.random.seed(number)
        coarse = registration.registration_ransac_based_on_feature_matching(
            b, a, features_b, features_a, True, 1.5 * VOXEL,
            registration.TransformationEstimationPointToPoint(False), 3,
            [registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
             registration.CorrespondenceCheckerBasedOnDistance(1.5 * VOXEL)],
            registration.RANSACConvergenceCriteria(100_000, 0.999))
        fine = registration.registration_icp(
            b, a, 1.5 * VOXEL, coarse.transformation, registration.TransformationEstimationPointToPlane())
        results.append((fine.transformation, fine.fitness))
    return results, featured - started, time.process_time() - featured


def run_cairn(binary, scenes, pairs):
    """[(pose, likelihood)], and CPU seconds of features (and all the rest) and of pairs."""
    wanted = [{"scene": s.name, "a": s.file(i), "b": s.file(j)} for s, i, j, _ in pairs]
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump(wanted, file)
        file.flush()
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [binary, "bench", "pairs", "--json", "--pairs", file.name, *[str(s.folder) for s in scenes]]
        report = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
        done = resource.getrusage(resource.RUSAGE_CHILDREN)
    results = [(np.array(p["a_from_b"] or np.eye(4)), p["likelihood"] if p["a_from_b"] else 0.0) for p in report["pairs"]]
    total = done.ru_utime + done.ru_stime - used.ru_utime - used.ru_stime
    return results, total - report["pairs_cpu_s"], report["pairs_cpu_s"]


def judge(pairs, results, accepted):
    """Counts of one program. A pose of a pair without overlap is right if it is the true one all the same."""
    close, rmse, right, wrong = 0, 0, 0, 0
    for (scene, i, j, overlaps), (pose, _), taken in zip(pairs, results, accepted):
        truth = scene.a_from_b(i, j)
        angle, distance = errors(pose, truth)
        is_close = angle < RIGHT_DEG and distance < RIGHT_M
        if overlaps:
            close += is_close
            rmse += within_rmse(pose, truth, scene.weights[i, j])
            right += is_close and taken
        wrong += taken and not is_close
    true_pairs = sum(pair[3] for pair in pairs)
    precision = right / max(right + wrong, 1)
    recall = right / true_pairs
    f1 = 2 * precision * recall / max(precision + recall, 1e-9)
    return {
        "close": close / true_pairs, "rmse": rmse / true_pairs,
        "recall": recall, "precision": precision, "f1": f1, "wrong": wrong,
    }


def best_threshold(pairs, results):
    """The least score to accept that gives the best F1 on these pairs."""
    candidates = sorted({score for _, score in results})
    return max(candidates, key=lambda t: judge(pairs, results, [score >= t for _, score in results])["f1"])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=pathlib.Path, metavar="SCENE")
    parser.add_argument("--cairn", default="target/release/cairn", help="the binary")
    parser.add_argument("--pairs", type=int, default=200, help="pairs altogether, half of them with overlap")
    args = parser.parse_args()

    scenes = [Scene(folder) for folder in args.scenes]
    pairs = [(s, *pair) for s in scenes for pair in s.choose(args.pairs // len(scenes))]
    ours, *our_seconds = run_cairn(args.cairn, scenes, pairs)
    theirs, *their_seconds = run_open3d(scenes, pairs)
    least = best_threshold(pairs, theirs)
    rows = [
        (f"Open3D {o3d.__version__}, fitness at least {least:.2f}", their_seconds,
         judge(pairs, theirs, [score >= least for _, score in theirs])),
        ("Cairn, likelier right than wrong", our_seconds, judge(pairs, ours, [score > 0.5 for _, score in ours])),
    ]
    overlapping = sum(pair[3] for pair in pairs)
    scans = len({(scene.name, scan) for scene, i, j, _ in pairs for scan in (i, j)})
    print(f"{len(pairs)} pairs of {scans} scans of {len(scenes)} scenes, {overlapping} with overlap\n")
    print("| | CPU ms a scan | CPU ms a pair | pose within 15 deg, 0.3 m | RMSE at most 0.2 m | recall of accepted | precision | wrong |")
    print("|---|---|---|---|---|---|---|---|")
    for name, (features, matching), m in rows:
        print(f"| {name} | {1e3 * features / scans:.1f} | {1e3 * matching / len(pairs):.1f} | {m['close']:.1%} | {m['rmse']:.1%} "
              f"| {m['recall']:.1%} | {m['precision']:.1%} | {m['wrong']} |")
    print(f"\nCPU time: {their_seconds[1] / our_seconds[1]:.0f} times less a pair, "
          f"{sum(their_seconds) / sum(our_seconds):.0f} times less with the features of these scans")
    return 0


if __name__ == "__main__":
    sys.exit(main())
