//! The engine's kernels on simulated scans: `cargo bench --bench engine`, or with a name behind it for one of them.
//!
//! Each says what bounds it, found with a sampling profiler and by exchanging parts, on a server processor with AVX-512; with narrower
//! vectors arithmetic weighs more. All run on one thread, on panoramic scans of 20,000 points.

use std::collections::BTreeSet;
use std::hint::black_box;
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};

use cairn::cloud::{PointCloud, ScanKey, normals};
use cairn::control::{CancelToken, Control, Seed, Silent};
use cairn::features::{
    Descriptor, PrepareOptions, Scan, SensorPosition, choose_resolution, fpfh, natural_resolution, prepare,
    signature,
};
use cairn::geometry::{NearestGrid, NeighborIndex, Point, Pose, voxel_centroids};
use cairn::graph::{ScanGraph, SupportOptions};
use cairn::pairwise::{
    ConsensusOptions, Match, PairKey, PairResult, consensus, icp, look, match_pair, mutual_matches,
    shipped_verifier,
};
use cairn::simulate::{BuildingOptions, Sensor, SurveyOptions, simulate};

/// What all kernels are given: scans of a small office, two of them that overlap well, and the truth about those.
struct Fixture {
    clouds: Vec<PointCloud>,
    options: PrepareOptions,
    scans: Vec<Arc<Scan>>,
    a_from_b: Pose,
    matches: Vec<Match>,
}

static FIXTURE: LazyLock<Fixture> = LazyLock::new(|| {
    // One thread, so that figures are CPU time.
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global().expect("no pool yet");
    let survey = simulate(&SurveyOptions {
        building: BuildingOptions { rooms: 3, ..BuildingOptions::default() },
        sensor: Sensor::panoramic(20_000),
        stations: 8,
        least_overlap: 0.5,
        seed: Seed(1),
        ..SurveyOptions::default()
    })
    .expect("a valid survey");
    let clouds: Vec<PointCloud> = survey.scans.iter().map(|scan| scan.cloud.clone()).collect();
    let natural: Vec<f64> = clouds.iter().map(|cloud| natural_resolution(&cloud.points)).collect();
    let options = PrepareOptions::at(choose_resolution(&natural), Seed(1));
    let scans: Vec<Arc<Scan>> =
        clouds.iter().zip(0..).map(|(cloud, key)| Arc::new(ready(cloud, ScanKey(key), &options))).collect();
    let overlaps = survey.overlaps(2.0 * options.resolution as f32);
    let second = (1..scans.len()).max_by(|i, j| overlaps[0][*i].total_cmp(&overlaps[0][*j])).expect("scans");
    // The pair comes first.
    let (mut clouds, mut scans) = (clouds, scans);
    clouds.swap(1, second);
    scans.swap(1, second);
    let in_local = |scan: usize, at: usize| {
        survey.scans[at].model_from_scan * scans[scan].prepared.local_from_scan().inverse()
    };
    let a_from_b = in_local(0, 0).inverse() * in_local(1, second);
    let matches = mutual_matches(&scans[0].prepared, &scans[1].prepared, 800);
    Fixture { clouds, options, scans, a_from_b, matches }
});

fn ready(cloud: &PointCloud, key: ScanKey, options: &PrepareOptions) -> Scan {
    let cancel = CancelToken::new();
    let control = Control { cancel: &cancel, observer: &Silent };
    Scan::new(
        prepare(key, cloud, SensorPosition::Assumed, options, control).expect("a scan that can be prepared"),
    )
}

/// The whole of ingest after decoding: the parts below, and the range image.
fn preparing(c: &mut Criterion) {
    let f = &*FIXTURE;
    c.bench_function("prepare", |b| b.iter(|| ready(black_box(&f.clouds[0]), ScanKey(0), &f.options)));
}

/// Half of it turns points into cells, three divisions for each, and sums them; the rest is bound by the stores of a radix sort by cell, three passes over
/// keys of 32 bits. The 20,000 points are in the second-level cache. A sort that compares took twice as long for all of it.
fn voxel_grid(c: &mut Criterion) {
    let f = &*FIXTURE;
    let size = f.options.resolution as f32 / 2.0;
    c.bench_function("voxel_centroids", |b| b.iter(|| voxel_centroids(black_box(&f.clouds[0].points), size)));
}

/// Half of it finds and copies what is around the queries of a cell, in nine runs of points; a fifth is arithmetic: the distances of about three times as
/// many points as lie in the radius and sums of products over those that do, sixteen points at once; a tenth the closed form of eight normals at once. With an
/// arccosine and two cosines for each normal, and cells sought anew for each query, it took twice as long. A kd-tree branches for every few
/// points: with one, lookups were two fifths of preparing a scan.
fn surface_normals(c: &mut Criterion) {
    let f = &*FIXTURE;
    let voxel = f.options.resolution as f32;
    let fine = voxel_centroids(&f.clouds[0].points, voxel / 2.0);
    let coarse = voxel_centroids(&fine, voxel);
    let index = NeighborIndex::new(&fine, 2.0 * voxel);
    c.bench_function("normals", |b| b.iter(|| normals(black_box(&coarse), &index, 2.0 * voxel)));
}

/// About 100 neighbours a point, each pair looked at once, in four parts of like size: finding it; its three angles, which are bound by the divisions and
/// roots of sixteen pairs at once; counting them, by stores; and adding the histogram of each of the two to the other's sum, by the second-level cache.
/// Where angles became numbers of bins through the language's conversion, which takes one at a time, they took half as long again; with one arctangent at
/// a time through libm, longer than all of this.
fn descriptors(c: &mut Criterion) {
    let f = &*FIXTURE;
    let scan = &f.scans[0].prepared;
    let radius = 5.0 * f.options.resolution as f32;
    c.bench_function("fpfh", |b| b.iter(|| fpfh(black_box(&scan.points), &scan.normals, radius)));
}

/// Bound by the throughput of fused multiply-add: 512 waves times all points times 33 numbers, as one product of matrices; a third is the cosine of
/// each, as a polynomial. Calling libm's cosine made it ten times as long; sums for one vector of points at a time, which wait for each other, twice.
fn signatures(c: &mut Criterion) {
    let f = &*FIXTURE;
    let scan = &f.scans[0].prepared;
    let all: Vec<Descriptor> = fpfh(&scan.points, &scan.normals, 5.0 * f.options.resolution as f32);
    c.bench_function("signature", |b| b.iter(|| signature(black_box(&all))));
}

/// Bound by stores: each point is offered to 49 or 98 rows of eight cells, compared and written back together. The cells and their distances
/// are in the second-level cache as the points come sorted. A branch for each cell that takes the point took longer.
fn nearest_grid(c: &mut Criterion) {
    let f = &*FIXTURE;
    let points: &[Point] = &f.scans[0].prepared.points;
    let size = f.options.resolution as f32;
    c.bench_function("nearest_grid", |b| b.iter(|| NearestGrid::new(black_box(points), size)));
}

/// Bound by the throughput of whole-number multiply-add: 2,000 x 2,000 x 17 of them, each of two pairs of 16 bits, are 80 % of the time, in tiles
/// of which twelve sums stay in registers; two threads of one core share it. In single precision it took nearly twice as long. The rest is mostly the two
/// best of each row and column, found while the product of twelve rows is near.
fn matching(c: &mut Criterion) {
    let [x, y] = [0, 1].map(|k: usize| &FIXTURE.scans[k].prepared);
    c.bench_function("mutual_matches", |b| b.iter(|| mutual_matches(black_box(x), black_box(y), 800)));
}

/// Bound by arithmetic in the first-level cache, in three parts of like size: which of all pairs of matches are compatible, and how many
/// third matches agree with both, on bit sets (AND and population count); closed-form fits from 60 seeds; and judging all
/// matches against each fit.
fn second_order_consensus(c: &mut Criterion) {
    let f = &*FIXTURE;
    let options = ConsensusOptions::default();
    c.bench_function("consensus", |b| {
        b.iter(|| consensus(&f.scans[0], &f.scans[1], black_box(&f.matches), &options));
    });
}

/// Bound by the latency of the second-level cache: a point of the other scan costs two loads that follow each other (brick, cell), then one of a
/// point with its normal, in places that the pose decides. They wait for each other across points as little as the
/// core allows, since nothing between them branches; with the branches it took more than twice as long. In a wrong pose points
/// also go to the range image, another load each.
fn verification(c: &mut Criterion) {
    let f = &*FIXTURE;
    let wrong = Pose::from_translation(nalgebra::Vector3::new(0.7, -0.4, 0.2)) * f.a_from_b;
    for (name, pose) in [("look, right pose", f.a_from_b), ("look, wrong pose", wrong)] {
        c.bench_function(name, |b| b.iter(|| look(&f.scans[0], &f.scans[1], black_box(&pose), 1)));
    }
}

/// Bound half by the same loads as a look, five times for 600 points and five times for 1,200, and half by the throughput of arithmetic: 27 sums a point of
/// the normal equations, more than the registers hold.
fn alignment(c: &mut Criterion) {
    let f = &*FIXTURE;
    let shift = 2.0 * f.options.resolution;
    let start = Pose::from_translation(nalgebra::Vector3::new(shift, -shift, 0.5 * shift)) * f.a_from_b;
    c.bench_function("icp", |b| b.iter(|| icp(&f.scans[0], &f.scans[1], black_box(&start))));
}

/// A pair from descriptors to verified hypotheses: matching, consensus, a quick look at twelve poses, ICP and two looks at six.
fn whole_pair(c: &mut Criterion) {
    let [x, y] = [0, 1].map(|k: usize| &FIXTURE.scans[k]);
    let verifier = shipped_verifier();
    c.bench_function("match_pair", |b| b.iter(|| match_pair(black_box(x), y, &verifier)));
}

/// Bound by products of 3 x 3 matrices: six hypotheses of each side of each triangle, 36 paths, each compared with six poses; most
/// comparisons end at the distance, before the angle. It is nothing beside the pairs themselves until scans are hundreds.
fn triplet_support(c: &mut Criterion) {
    let scans = &FIXTURE.scans;
    let options = SupportOptions::default();
    let mut bare = ScanGraph::new();
    for scan in scans {
        bare.add_scan(scan.clone());
    }
    let pairs: BTreeSet<PairKey> = scans
        .iter()
        .flat_map(|x| scans.iter().map(|y| PairKey::of(x.key(), y.key())))
        .filter(|pair| pair.a != pair.b)
        .collect();
    let cancel = CancelToken::new();
    let control = Control { cancel: &cancel, observer: &Silent };
    let results: Vec<PairResult> = bare.clone().try_pairs(&pairs, &options, control).expect("nobody cancels");
    c.bench_function("triplet support of 28 pairs", |b| {
        b.iter_batched(
            || (bare.clone(), results.clone()),
            |(mut graph, results)| {
                graph.add_results(results, &options);
                graph
            },
            BatchSize::SmallInput,
        );
    });
}

criterion_group! {
    name = engine;
    config = Criterion::default()
        .sample_size(20)
        .warm_up_time(Duration::from_millis(300))
        .measurement_time(Duration::from_secs(1));
    targets = preparing, voxel_grid, surface_normals, descriptors, signatures, nearest_grid, matching,
        second_order_consensus, verification, alignment, whole_pair, triplet_support
}
criterion_main!(engine);
