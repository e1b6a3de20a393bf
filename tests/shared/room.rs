//! A small scan, for the tests that drive the service from outside.

use std::fmt::Write as _;

/// A corner of a furnished room as an ascii PLY file: a floor and two walls with boxes, seen from a corner that `shift`
/// (metres) moves, so that different shifts are overlapping, different scans.
pub fn room(shift: f64) -> Vec<u8> {
    let mut points: Vec<[f64; 3]> = Vec::new();
    let mut patch = |corner: [f64; 3], u: [f64; 3], v: [f64; 3]| {
        for i in 0..40 {
            for j in 0..40 {
                let (a, b) = (f64::from(i) / 40.0, f64::from(j) / 40.0);
                points.push(std::array::from_fn(|k| corner[k] + a * u[k] + b * v[k]));
            }
        }
    };
    patch([0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]);
    patch([0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 2.5]);
    patch([0.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 2.5]);
    for [x, y, size] in [[1.0, 1.2, 0.5], [2.7, 0.9, 0.8], [1.9, 2.8, 0.35], [3.2, 3.1, 0.6]] {
        patch([x, y, size], [size, 0.0, 0.0], [0.0, size * 1.3, 0.0]);
        patch([x, y, 0.0], [size, 0.0, 0.0], [0.0, 0.0, size]);
        patch([x, y, 0.0], [0.0, size * 1.3, 0.0], [0.0, 0.0, size]);
    }
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
        points.len()
    );
    for [x, y, z] in points {
        let _ = writeln!(text, "{:.4} {:.4} {:.4}", x - 2.0 - shift, y - 2.0 + 0.3 * shift, z - 1.3);
    }
    text.into_bytes()
}
