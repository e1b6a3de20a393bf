//! What scans say of free space, on simulated scenes with known truth: true poses hardly violate it whatever makes scans disagree,
//! wrong ones do, and nothing is said of it where the sensor did not stand where it is assumed to have stood.

use cairn::cloud::{PointCloud, ScanKey};
use cairn::control::{CancelToken, Control, Seed, Silent};
use cairn::features::{PrepareOptions, PreparedScan, Scan, SensorPosition, prepare};
use cairn::geometry::Pose;
use cairn::pairwise::look;
use cairn::simulate::{
    BuildingOptions, Hazards, Layout, Ray, Scene, Sensor, Shape, Solid, Survey, SurveyOptions, simulate,
};
use nalgebra::{Rotation3, Vector3};

fn prepared(cloud: &PointCloud, key: u128, resolution: f64) -> PreparedScan {
    let cancel = CancelToken::new();
    let control = Control { cancel: &cancel, observer: &Silent };
    let options = PrepareOptions::at(resolution, Seed(0));
    prepare(ScanKey(key), cloud, SensorPosition::Assumed, &options, control)
        .expect("the scan is large enough")
}

fn scans(survey: &Survey, resolution: f64) -> Vec<Scan> {
    let keyed = survey.scans.iter().zip(1..);
    keyed.map(|(scan, key)| Scan::new(prepared(&scan.cloud, key, resolution))).collect()
}

/// Shares of violations of all pairs that overlap: at the truth, and after `wrong` moved the second scan.
fn violations(survey: &Survey, resolution: f64, wrong: &Pose) -> (Vec<f64>, Vec<f64>) {
    let scans = scans(survey, resolution);
    for scan in &scans {
        assert!(scan.prepared.range_image.is_some(), "hidden share {}", scan.prepared.hidden_share);
    }
    let (mut right_shares, mut wrong_shares) = (Vec::new(), Vec::new());
    for (i, a) in scans.iter().enumerate() {
        for (j, b) in scans.iter().enumerate().skip(i + 1) {
            let a_from_b = survey.scans[i].model_from_scan.inverse() * survey.scans[j].model_from_scan;
            let counts = |pose: &Pose| look(a, b, pose, 1).plus(&look(b, a, &pose.inverse(), 1));
            let truth = counts(&a_from_b);
            if truth.overlap() > 0.15 {
                right_shares.push(truth.violation_share());
                wrong_shares.push(counts(&(a_from_b * *wrong)).violation_share());
            }
        }
    }
    assert!(right_shares.len() >= 4, "only {} pairs overlap", right_shares.len());
    right_shares.sort_by(f64::total_cmp);
    wrong_shares.sort_by(f64::total_cmp);
    (right_shares, wrong_shares)
}

fn at(sorted: &[f64], quantile: f64) -> f64 {
    sorted[((sorted.len() - 1) as f64 * quantile).round() as usize]
}

/// A quarter turn about the vertical of a scanner, and most of a metre aside.
fn turned() -> Pose {
    Pose::new(Rotation3::new(Vector3::z() * std::f64::consts::FRAC_PI_2), Vector3::new(0.8, 0.4, 0.3))
}

/// A camera taken for one that stands most of a metre ahead of it, and a little turned: what it sees then hangs in the air.
fn ahead() -> Pose {
    Pose::new(Rotation3::new(Vector3::y() * 0.2), Vector3::new(0.1, 0.0, -0.9))
}

fn survey(layout: Layout, sensor: Sensor, stations: usize, hazards: Hazards) -> Survey {
    let building = BuildingOptions { layout, rooms: 3, hazards, ..BuildingOptions::default() };
    let options = SurveyOptions { building, sensor, stations, seed: Seed(41), ..SurveyOptions::default() };
    simulate(&options).expect("the options are sound")
}

#[test]
fn glass_mirrors_thin_structure_and_dark_surfaces_do_not_make_true_poses_violate_free_space() {
    let hard = Hazards { glass: 0.5, mirrors: 0.5, thin: 1.0, dark: 0.4 };
    for (sensor, resolution) in [(Sensor::panoramic(24_000), 0.14), (Sensor::moving_lidar(64), 0.18)] {
        let survey = survey(Layout::Office, sensor, 8, hard);
        let (right, wrong) = violations(&survey, resolution, &turned());
        assert!(at(&right, 0.9) < 0.03, "{right:?}");
        assert!(at(&wrong, 0.1) > 3.0 * at(&right, 0.9), "{right:?} {wrong:?}");
    }
}

#[test]
fn fragments_of_a_moving_camera_are_believed_to_stand_at_their_first_frame() {
    let hard = Hazards { glass: 0.4, mirrors: 0.2, thin: 0.6, dark: 0.2 };
    let survey = survey(Layout::House, Sensor::fragment(6), 12, hard);
    let (right, wrong) = violations(&survey, 0.07, &ahead());
    assert!(at(&right, 0.9) < 0.02, "{right:?}");
    assert!(at(&wrong, 0.25) > 0.1 && at(&wrong, 0.25) > 5.0 * at(&right, 0.9), "{right:?} {wrong:?}");
}

/// What a scanner that looks along its z axis from the world's origin sees of a few solids, in steps of `step` radians.
fn seen(solids: &[Solid], step: f32) -> Vec<Vector3<f32>> {
    let scene = Scene::new(solids);
    let at = |i: i32, j: i32| Vector3::new(i as f32 * step, j as f32 * step, 1.0).normalize();
    let rays = (-120..=120).flat_map(|i| (-120..=120).map(move |j| at(i, j)));
    rays.filter_map(|direction| {
        let ray = Ray { origin: Vector3::zeros(), direction };
        scene.cast(&ray, 0.0, 9.0).map(|hit| direction * hit.distance)
    })
    .collect()
}

#[test]
fn a_statue_that_was_scanned_from_elsewhere_than_its_origin_says_nothing_of_free_space() {
    let ball = |radius: f32, centre: [f32; 3]| Solid::new(Shape::Ball { radius }, Vector3::from(centre));
    let statue = [
        ball(0.05, [0.0, 0.0, 0.7]),
        ball(0.03, [0.0, -0.07, 0.68]),
        ball(0.025, [0.06, 0.02, 0.66]),
        ball(0.025, [-0.06, 0.03, 0.69]),
        Solid::rod(Vector3::new(0.03, -0.1, 0.66), Vector3::new(-0.05, 0.1, 0.72), 0.012),
    ];
    let points = seen(&statue, 0.0012);
    let cloud =
        |offset: Vector3<f32>| PointCloud::from_points(points.iter().map(|p| (p - offset).into()).collect());
    let from_scanner = prepared(&cloud(Vector3::zeros()), 1, 0.0026);
    assert!(from_scanner.range_image.is_some(), "hidden {}", from_scanner.hidden_share);
    // Its frame begins on the turntable under it, beside it, or just behind it.
    for origin in [[0.0, 0.16, 0.7], [0.25, 0.0, 0.7], [0.0, 0.12, 0.74]] {
        let statue = prepared(&cloud(Vector3::from(origin)), 1, 0.0026);
        assert!(statue.range_image.is_none(), "from {origin:?} {} is hidden", statue.hidden_share);
    }
}
