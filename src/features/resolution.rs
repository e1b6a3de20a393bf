//! The one length from which all others derive.

use crate::geometry::{Point, occupied_voxels};

/// A scan's extent divided by this is its voxel size, unless that leaves it too few voxels.
const EXTENT_VOXELS: f64 = 75.0;
/// Where a scan fills fewer voxels than this, smaller voxels are taken …
const ENOUGH_VOXELS: usize = 4000;
/// … as long as a voxel still holds this many points on average.
const POINTS_A_VOXEL: f64 = 2.5;
/// Steps of the ladder per factor of two.
const LADDER: f64 = 8.0;
/// No voxel is made smaller than this, metres: it is the finest resolution that a project may be set to.
const FINEST: f64 = 1e-5;
/// Used when there are no scans. Metres.
const DEFAULT_RESOLUTION: f64 = 0.05;

/// The extent of a scan: the diagonal of the box between the 2nd and 98th percentile of each coordinate, metres.
#[must_use]
pub fn extent(points: &[Point]) -> f64 {
    if points.is_empty() {
        return 0.0;
    }
    let mut square = 0.0;
    for k in 0..3 {
        let mut axis: Vec<f32> = points.iter().map(|p| p[k]).collect();
        let at = |share: f64| ((axis.len() - 1) as f64 * share).round() as usize;
        let (lower, upper) = (at(0.02), at(0.98));
        let (_, low, above) = axis.select_nth_unstable_by(lower, f32::total_cmp);
        let high = match (upper - lower).checked_sub(1) {
            Some(next) => *above.select_nth_unstable_by(next, f32::total_cmp).1,
            None => *low,
        };
        square += (f64::from(high) - f64::from(*low)).powi(2);
    }
    square.sqrt()
}

/// The voxel size at which one scan alone would best be registered, metres; 0 for a scan without extent.
#[must_use]
pub fn natural_resolution(points: &[Point]) -> f64 {
    let mut size = extent(points) / EXTENT_VOXELS;
    if !(size > 0.0 && size.is_finite()) {
        return 0.0;
    }
    let step = 0.5_f64.powf(1.0 / LADDER);
    let mut occupied = occupied_voxels(points, size as f32);
    while occupied < ENOUGH_VOXELS && size > FINEST {
        let smaller = size * step;
        let more = occupied_voxels(points, smaller as f32);
        if (points.len() as f64) < POINTS_A_VOXEL * more as f64 {
            break;
        }
        // Where points lie on each other, smaller voxels may show no more however small they are.
        let no_more = more == occupied && occupied_voxels(points, (size / 2.0) as f32) == occupied;
        size = if no_more { size / 2.0 } else { smaller };
        occupied = more;
    }
    size
}

/// The resolution for scans of these natural resolutions (metres): their median, rounded to a ladder of eight steps per
/// factor of two so that one more scan seldom changes it. The order does not matter.
#[must_use]
pub fn choose_resolution(natural: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = natural.iter().copied().filter(|s| *s > 0.0 && s.is_finite()).collect();
    sizes.sort_by(f64::total_cmp);
    let Some(median) = sizes.get(sizes.len() / 2) else { return DEFAULT_RESOLUTION };
    let steps = ((median / DEFAULT_RESOLUTION).log2() * LADDER).round();
    DEFAULT_RESOLUTION * (steps / LADDER).exp2()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn box_of(size: f32) -> Vec<Point> {
        (0..60_000).map(|i| [(i % 200) as f32 / 200.0 * size, (i / 200) as f32 / 300.0 * size, 0.0]).collect()
    }

    #[test]
    fn the_resolution_follows_the_scale_of_the_data() {
        let small = natural_resolution(&box_of(0.2));
        let large = natural_resolution(&box_of(200.0));
        assert!((large / small / 1000.0 - 1.0).abs() < 0.02, "{small} {large}");
    }

    #[test]
    fn one_more_scan_of_the_same_kind_changes_nothing() {
        let few = choose_resolution(&[0.049, 0.050, 0.051]);
        assert!((choose_resolution(&[0.051, 0.049, 0.050, 0.0501]) - few).abs() < 1e-12);
        assert!((choose_resolution(&[]) - 0.05).abs() < 1e-12);
    }

    #[test]
    fn copies_of_a_few_points_come_to_an_end() {
        let few: Vec<Point> = (0..1000).map(|i| [(i % 5) as f32, (i % 3) as f32, 0.0]).collect();
        let size = natural_resolution(&few);
        assert!(size > FINEST / 4.0 && size < 0.1, "{size}");
    }

    #[test]
    fn stray_points_do_not_stretch_the_extent() {
        let mut points = box_of(2.0);
        let before = extent(&points);
        points.push([1e6, 0.0, 0.0]);
        assert!((extent(&points) / before - 1.0).abs() < 0.01);
    }
}
