//! The kinds of sensor: where their rays go, how far they reach and how they err. Used by
//! [`super::acquire`], which casts the rays, and by the stations, which look along some of them.

use nalgebra::Vector3;

use super::motion::Motion;

/// How a sensor errs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// Standard deviation of a distance close to the sensor, metres.
    pub base: f32,
    /// Growth of the standard deviation with the square of the distance, 1/metres.
    pub growth: f32,
    /// Probability that a ray which meets an ordinary surface squarely returns nothing.
    pub dropout: f32,
    /// Probability that a ray beside an edge returns a point between the two surfaces (a flying pixel).
    pub mixed: f32,
}

impl Noise {
    /// Standard deviation of a distance, both in metres.
    #[must_use]
    pub fn sigma(&self, distance: f32) -> f32 {
        self.base + self.growth * distance * distance
    }

    /// The same kind of noise, everything `factor` times as much.
    #[must_use]
    pub fn scaled(&self, factor: f32) -> Self {
        Self {
            base: self.base * factor,
            growth: self.growth * factor,
            dropout: (self.dropout * factor).min(1.0),
            mixed: (self.mixed * factor).min(1.0),
        }
    }
}

/// What the rays of a sensor look like. Angles in degrees here, as data sheets give them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pattern {
    /// A pinhole camera: z forwards, x to the right, y down; one ray a pixel.
    DepthCamera {
        /// Pixels across.
        columns: usize,
        /// Pixels down.
        rows: usize,
        /// Full horizontal and vertical field of view.
        field_of_view_deg: [f32; 2],
    },
    /// A levelled laser scanner on a tripod, z up: rays spread evenly over the sphere above `lowest_deg`.
    Panoramic {
        /// About how many rays.
        rays: usize,
        /// Elevation of the lowest rays; below, the tripod hides the floor.
        lowest_deg: f32,
    },
    /// Rings of rays that spin about z, which is up.
    SpinningLidar {
        /// Number of lasers, spread evenly over the elevations.
        rings: usize,
        /// Rays of a ring in one revolution.
        columns: usize,
        /// Lowest and highest elevation.
        elevation_deg: [f32; 2],
        /// Revolutions in one scan. The sensor nods between them, so that the gaps between the rings fill.
        revolutions: usize,
    },
}

/// A sensor at the origin of its own frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sensor {
    /// Where its rays go.
    pub pattern: Pattern,
    /// Nearest and farthest distance that it measures, metres.
    pub range: [f32; 2],
    /// How it errs.
    pub noise: Noise,
    /// How it moves while it takes a scan, if it does. A moving camera takes frames, which are fused in the frame of the first.
    pub motion: Option<Motion>,
    /// How well a tripod is levelled: the standard deviation of each of its two tilts, degrees. A camera is held by hand.
    pub tilt_deg: f32,
}

/// Why a sensor cannot be simulated.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum SensorError {
    /// No ray, or too many to hold.
    #[error("a scan has 1 to 20 million rays, not {0}")]
    Rays(usize),
    /// Not an interval of distances.
    #[error("the range must be an interval of finite distances, not {0} m to {1} m")]
    Range(f32, f32),
    /// An angle that the pattern does not allow.
    #[error("the angle of {0} degrees is out of range")]
    Angle(f32),
    /// A deviation below zero or a probability outside 0 to 1.
    #[error("noise must not be negative, and its probabilities at most 1")]
    Noise,
    /// No frame, or a way that no sensor makes during a scan.
    #[error(
        "a sensor that moves takes 2 to 1000 frames on at most 10 m and 180 degrees, and loses at most 1 m"
    )]
    Motion,
}

/// Nod of a spinning `LiDAR` from one revolution to the next, radians: an irrational share of a ring's spacing.
const NOD: f32 = 0.031;

/// Unit directions in the sensor frame, row by row.
#[derive(Debug, Clone)]
pub(super) struct Raster {
    pub rows: Vec<Vec<Vector3<f32>>>,
    /// Whether the first ray of a row is a neighbour of its last.
    pub wraps: bool,
    /// Whether rays of successive rows are so close that they can see the same edge.
    pub rows_touch: bool,
}

impl Sensor {
    /// A depth camera of the kind that phones and robots carry: 58 by 45 degrees, 0.4 to 5 m, noise that grows with
    /// the square of the distance.
    #[must_use]
    pub fn depth_camera(columns: usize, rows: usize) -> Self {
        Self {
            pattern: Pattern::DepthCamera { columns, rows, field_of_view_deg: [58.0, 45.0] },
            range: [0.4, 5.0],
            noise: Noise { base: 0.001, growth: 0.0016, dropout: 0.01, mixed: 0.3 },
            motion: None,
            tilt_deg: 0.7,
        }
    }

    /// A depth camera that is moved by hand along a short way while it takes frames, which are fused to one cloud in the
    /// coordinates of the first: so the sensor stood at the scan's origin only at the start. The frames are placed with small errors.
    #[must_use]
    pub fn fragment(frames: usize) -> Self {
        let motion = Motion { frames, way: 0.4, turn_deg: 20.0, drift: 0.004 };
        Self { motion: Some(motion), ..Self::depth_camera(160, 120) }
    }

    /// A terrestrial laser scanner: 0.3 to 30 m, millimetre noise.
    #[must_use]
    pub fn panoramic(rays: usize) -> Self {
        Self {
            pattern: Pattern::Panoramic { rays, lowest_deg: -60.0 },
            range: [0.3, 30.0],
            noise: Noise { base: 0.002, growth: 1e-5, dropout: 0.01, mixed: 0.3 },
            motion: None,
            tilt_deg: 0.7,
        }
    }

    /// A spinning `LiDAR` with 16, 32, 64 or any number of rings: 0.5 to 100 m, centimetre noise, one revolution.
    #[must_use]
    pub fn spinning_lidar(rings: usize) -> Self {
        Self {
            pattern: Pattern::SpinningLidar {
                rings,
                columns: 1024,
                elevation_deg: [-25.0, 20.0],
                revolutions: 1,
            },
            range: [0.5, 100.0],
            noise: Noise { base: 0.012, growth: 2e-6, dropout: 0.02, mixed: 0.15 },
            motion: None,
            tilt_deg: 0.7,
        }
    }

    /// The same on a vehicle or a walking robot: it moves by 0.3 m during its revolution, which is put right up to an error of a
    /// centimetre.
    #[must_use]
    pub fn moving_lidar(rings: usize) -> Self {
        let motion = Motion { frames: rings, way: 0.3, turn_deg: 4.0, drift: 0.01 };
        Self { motion: Some(motion), ..Self::spinning_lidar(rings) }
    }

    /// Whether the sensor looks into one direction (z) rather than all around (z up).
    #[must_use]
    pub fn looks_ahead(&self) -> bool {
        matches!(self.pattern, Pattern::DepthCamera { .. })
    }

    /// Checks that the sensor can be simulated.
    pub fn validate(&self) -> Result<(), SensorError> {
        let (rays, angles): (usize, [f32; 2]) = match self.pattern {
            Pattern::DepthCamera { columns, rows, field_of_view_deg: [across, down] } => {
                if let Some(&angle) = [across, down].iter().find(|angle| !(1.0..=170.0).contains(*angle)) {
                    return Err(SensorError::Angle(angle));
                }
                (columns.saturating_mul(rows), [0.0; 2])
            }
            Pattern::Panoramic { rays, lowest_deg } => (rays, [lowest_deg, 0.0]),
            Pattern::SpinningLidar { rings, columns, elevation_deg, revolutions } => {
                (rings.saturating_mul(columns).saturating_mul(revolutions), elevation_deg)
            }
        };
        if !(1..=20_000_000).contains(&rays) {
            return Err(SensorError::Rays(rays));
        }
        if let Some(&angle) = angles.iter().find(|angle| !(-90.0..90.0).contains(*angle)) {
            return Err(SensorError::Angle(angle));
        }
        if !(0.0..=45.0).contains(&self.tilt_deg) {
            return Err(SensorError::Angle(self.tilt_deg));
        }
        let [near, far] = self.range;
        if !(near >= 0.0 && far > near && far.is_finite()) {
            return Err(SensorError::Range(near, far));
        }
        let Noise { base, growth, dropout, mixed } = self.noise;
        let probabilities = [dropout, mixed].iter().all(|p| (0.0..=1.0).contains(p));
        if !(probabilities && (0.0..=10.0).contains(&base) && (0.0..=10.0).contains(&growth)) {
            return Err(SensorError::Noise);
        }
        if let Some(Motion { frames, way, turn_deg, drift }) = self.motion
            && !((2..=1000).contains(&frames)
                && (0.0..=10.0).contains(&way)
                && (0.0..=180.0).contains(&turn_deg)
                && (0.0..=1.0).contains(&drift))
        {
            return Err(SensorError::Motion);
        }
        Ok(())
    }

    /// The rays of one scan.
    pub(super) fn raster(&self) -> Raster {
        match self.pattern {
            Pattern::DepthCamera { columns, rows, field_of_view_deg } => {
                let [x, y] = field_of_view_deg.map(|angle| (angle.to_radians() * 0.5).tan());
                let at = |i: usize, n: usize| (2.0 * i as f32 + 1.0) / n as f32 - 1.0;
                let pixel = |c, r| Vector3::new(x * at(c, columns), y * at(r, rows), 1.0).normalize();
                let row = |r| (0..columns).map(|c| pixel(c, r)).collect();
                Raster { rows: (0..rows).map(row).collect(), wraps: false, rows_touch: true }
            }
            Pattern::Panoramic { rays, lowest_deg } => {
                let lowest = lowest_deg.to_radians();
                let solid_angle = std::f32::consts::TAU * (1.0 - lowest.sin());
                let step = (solid_angle / rays as f32).sqrt();
                let rows = ((std::f32::consts::FRAC_PI_2 - lowest) / step).round().max(1.0) as usize;
                let row = |r: usize| {
                    let elevation =
                        lowest + (r as f32 + 0.5) / rows as f32 * (std::f32::consts::FRAC_PI_2 - lowest);
                    let columns = (std::f32::consts::TAU * elevation.cos() / step).round().max(1.0) as usize;
                    ring(columns, elevation, 0.0)
                };
                Raster { rows: (0..rows).map(row).collect(), wraps: true, rows_touch: true }
            }
            Pattern::SpinningLidar { rings, columns, elevation_deg: [low, high], revolutions } => {
                let row = |i: usize| {
                    let (revolution, r) = ((i / rings) as f32, i % rings);
                    let share = r as f32 / (rings - 1).max(1) as f32;
                    ring(columns, (low + share * (high - low)).to_radians(), NOD * revolution)
                };
                Raster { rows: (0..rings * revolutions).map(row).collect(), wraps: true, rows_touch: false }
            }
        }
    }
}

/// A ring about z at an elevation, nodded about x.
fn ring(columns: usize, elevation: f32, nod: f32) -> Vec<Vector3<f32>> {
    let ((up, out), (nod_sin, nod_cos)) = (elevation.sin_cos(), nod.sin_cos());
    let turn = |c: usize| {
        let (sin, cos) = (std::f32::consts::TAU * c as f32 / columns as f32).sin_cos();
        let (x, y) = (out * cos, out * sin);
        Vector3::new(x, nod_cos * y - nod_sin * up, nod_sin * y + nod_cos * up)
    };
    (0..columns).map(turn).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_are_unit_vectors_in_the_sensors_own_axes() {
        for sensor in [Sensor::depth_camera(40, 30), Sensor::panoramic(3000), Sensor::spinning_lidar(16)] {
            let raster = sensor.raster();
            assert!(raster.rows.iter().flatten().all(|d| (d.norm() - 1.0).abs() < 1e-5));
        }
        let camera = Sensor::depth_camera(40, 30).raster();
        let corner = camera.rows[0][0];
        assert!(corner.x < 0.0 && corner.y < 0.0 && corner.z > 0.8, "the first pixel is up and to the left");
    }

    #[test]
    fn a_panoramic_scanner_has_about_as_many_rays_as_asked_and_spreads_them_evenly() {
        let raster = Sensor::panoramic(36_000).raster();
        let rays: Vec<_> = raster.rows.iter().flatten().collect();
        assert!(rays.len().abs_diff(36_000) < 1000, "{}", rays.len());
        // The part of the sphere above 30 degrees is 0.5 / (1 + sin 60) of what the scanner sees.
        let high = rays.iter().filter(|d| d.z > 0.5).count() as f32 / rays.len() as f32;
        assert!((high - 0.5 / (1.0 + 0.75f32.sqrt())).abs() < 0.01, "{high}");
    }

    #[test]
    fn impossible_sensors_are_refused() {
        assert_eq!(Sensor::panoramic(0).validate(), Err(SensorError::Rays(0)));
        assert_eq!(Sensor::depth_camera(usize::MAX, 2).validate(), Err(SensorError::Rays(usize::MAX)));
        let backwards = Sensor { range: [3.0, 1.0], ..Sensor::panoramic(10) };
        assert_eq!(backwards.validate(), Err(SensorError::Range(3.0, 1.0)));
        let noise = Noise { base: f32::NAN, ..Sensor::panoramic(10).noise };
        assert_eq!(Sensor { noise, ..Sensor::panoramic(10) }.validate(), Err(SensorError::Noise));
        let still = Some(Motion { frames: 1, way: 0.0, turn_deg: 0.0, drift: 0.0 });
        assert_eq!(Sensor { motion: still, ..Sensor::fragment(9) }.validate(), Err(SensorError::Motion));
        assert_eq!(Sensor::spinning_lidar(32).validate(), Ok(()));
    }
}
