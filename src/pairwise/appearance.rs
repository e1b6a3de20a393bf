//! Colour as evidence for a pose: do the surfaces that it lays onto each other look alike? Geometry cannot tell the ends of a symmetric
//! hall apart, but their colours may.

use serde::{Deserialize, Serialize};

use super::contacts::{Motion, meet};
use super::dense::{NEAR_VOXELS, NORMAL_DOT};
use crate::features::Scan;
use crate::geometry::Pose;

/// Points that are compared, about.
const POINTS: usize = 4000;
/// Fewer contacts than this say nothing.
const LEAST_CONTACTS: usize = 60;
/// Colours that vary by less than this are one colour and noise (standard deviation of a channel, of 255).
const LEAST_SPREAD: f64 = 6.0;
/// Wrong assignments of colours that show what chance gives.
const SHIFTS: usize = 15;

/// How alike surfaces look that meet.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Appearance {
    /// Correlation of the colours that meet, over all channels, from -1 to 1. Exposure, which differs between scans, leaves it as it is;
    /// gains that differ between channels take a little from it (a white balance of 0.6, 1 and 1.5 leaves 0.94 of 1).
    pub correlation: f32,
    /// What is to be expected of colours that have nothing to do with each other: little where many surfaces meet, much where two do.
    pub by_chance: f32,
}

/// Compares the colours of b with those of the surfaces in a that they meet. `None` where either scan has no colours, too little
/// meets, or either side is of one colour.
#[must_use]
pub fn appearance(a: &Scan, b: &Scan, a_from_b: &Pose) -> Option<Appearance> {
    let (in_a, in_b) = (&a.prepared.colors, &b.prepared.colors);
    if in_a.is_empty() || in_b.is_empty() {
        return None;
    }
    let near = (NEAR_VOXELS * a.prepared.resolution as f32).powi(2);
    let stride = (b.prepared.points.len() / POINTS).max(1);
    let motion = Motion::of(a_from_b);
    let (mut of_a, mut of_b) = (Vec::new(), Vec::new());
    meet(a, b, &motion, (0, stride), |block, first| {
        for i in 0..block.len {
            if block.square[i] < near
                && block.agreement(i) > NORMAL_DOT
                && let (Some(x), Some(y)) = (in_a.get(block.near(i)), in_b.get(first + i * stride))
            {
                of_a.push(x.map(f32::from));
                of_b.push(y.map(f32::from));
            }
        }
    });
    if of_a.len() < LEAST_CONTACTS {
        return None;
    }
    let (spread_a, spread_b) = (centre(&mut of_a), centre(&mut of_b));
    if spread_a.min(spread_b) < LEAST_SPREAD {
        return None;
    }
    let whole = 3.0 * of_a.len() as f64 * spread_a * spread_b;
    let correlation = |shift| shifted_product(&of_a, &of_b, shift) / whole;
    // Points lie in the order of their voxels, so that neighbours stay neighbours when the one list is shifted against the other.
    let shifts = (1..=SHIFTS).map(|k| correlation(k * of_a.len() / (SHIFTS + 1)));
    let by_chance = (shifts.map(|r| r * r).sum::<f64>() / SHIFTS as f64).sqrt();
    Some(Appearance { correlation: correlation(0) as f32, by_chance: by_chance as f32 })
}

/// Takes the mean of each channel away, and returns the standard deviation of all.
fn centre(colors: &mut [[f32; 3]]) -> f64 {
    let n = colors.len() as f64;
    let mut square = 0.0;
    for k in 0..3 {
        let mean = colors.iter().map(|color| f64::from(color[k])).sum::<f64>() / n;
        for color in colors.iter_mut() {
            color[k] -= mean as f32;
            square += f64::from(color[k] * color[k]);
        }
    }
    (square / (3.0 * n)).sqrt()
}

/// Sum of the products of one list with the other, that begins `shift` later and goes around.
fn shifted_product(x: &[[f32; 3]], y: &[[f32; 3]], shift: usize) -> f64 {
    let (end, start) = y.split_at(shift.min(y.len()));
    let around = start.iter().chain(end);
    x.iter().zip(around).map(|(x, y)| f64::from(x[0] * y[0] + x[1] * y[1] + x[2] * y[2])).sum()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::*;
    use crate::cloud::{PointCloud, ScanKey};
    use crate::control::{CancelToken, Control, Seed, Silent};
    use crate::features::{PrepareOptions, SensorPosition, prepare};

    /// A closed box of 4 m by 4 m by 2.4 m around the sensor, whose walls have these colours, by the direction that they are in.
    fn room(key: u128, walls: impl Fn(f32) -> [u8; 3]) -> Scan {
        let mut cloud = PointCloud::default();
        for step in 0..25_600_u32 {
            let (u, v) = ((step % 160) as f32 / 160.0, (step / 160) as f32 / 160.0);
            let (turn, height) = (u * std::f32::consts::TAU, v * 2.4 - 1.2);
            let (sin, cos) = turn.sin_cos();
            let reach = 2.0 / sin.abs().max(cos.abs());
            cloud.points.push([reach * cos, reach * sin, height]);
            cloud.colors.push(walls(turn));
        }
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let options = PrepareOptions::at(0.08, Seed(0));
        Scan::new(prepare(ScanKey(key), &cloud, SensorPosition::Assumed, &options, control).expect("a room"))
    }

    fn turned(quarters: f64) -> Pose {
        let angle = quarters * std::f64::consts::FRAC_PI_2;
        Pose::new(Rotation3::from_axis_angle(&Vector3::z_axis(), angle), Vector3::zeros())
    }

    #[test]
    fn only_colours_tell_the_quarter_turns_of_a_square_room_apart_whatever_the_exposure() {
        let painted = |turn: f32| [(40.0 + 30.0 * turn) as u8, 120, (200.0 - 20.0 * turn) as u8];
        let bright = room(1, painted);
        let dark = room(2, |turn| painted(turn).map(|channel| channel / 2 + 7));
        assert!(appearance(&bright, &dark, &turned(0.0)).expect("colours differ").correlation > 0.95);
        for quarters in 1..4 {
            let seen = appearance(&bright, &dark, &turned(f64::from(quarters))).expect("colours differ");
            assert!(seen.correlation < 0.5, "{seen:?}");
        }
    }

    #[test]
    fn chance_gives_more_where_few_colours_meet() {
        let halves = room(1, |turn| [if turn < std::f32::consts::PI { 40 } else { 200 }; 3]);
        let stripes = room(2, |turn| [if ((turn * 8.0) as u32).is_multiple_of(2) { 40 } else { 200 }; 3]);
        let by_chance = |scan| appearance(scan, scan, &turned(0.0)).expect("colours differ").by_chance;
        assert!(
            by_chance(&stripes) < 0.7 * by_chance(&halves),
            "{} {}",
            by_chance(&stripes),
            by_chance(&halves)
        );
    }

    #[test]
    fn without_colours_or_with_one_alone_nothing_is_said() {
        let painted = room(1, |turn| [(40.0 * turn) as u8; 3]);
        let white = room(2, |turn| [250 - (turn as u8 % 2); 3]);
        let mut bare = room(3, |_| [0; 3]);
        bare.prepared.colors.clear();
        for other in [&white, &bare] {
            assert_eq!(appearance(&painted, other, &turned(0.0)), None);
            assert_eq!(appearance(other, &painted, &turned(0.0)), None);
        }
        let away = Pose::from_translation(Vector3::new(50.0, 0.0, 0.0));
        assert_eq!(appearance(&painted, &painted, &away), None);
    }
}
