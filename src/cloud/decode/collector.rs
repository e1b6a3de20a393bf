//! Gathers the points of a file: scaled to metres, checked, relative to a sound origin.

use super::{DecodeError, DecodeOptions};
use crate::cloud::PointCloud;

/// How many points decide whether the file needs an origin of its own. Kept in f64 until then.
const PROBE_POINTS: usize = 4096;

/// Up to here single precision keeps 0.03 mm; beyond, it would lose tenths of a millimetre and then more.
const FAR_M: f64 = 1000.0;

/// No place on Earth has larger coordinates in any usual system; larger ones are garbage.
const MAX_COORDINATE_M: f64 = 1e8;

/// Never reserve for more points than this on a header's word.
const MAX_RESERVED: u64 = 65_536;

/// Builds a [`PointCloud`] point by point.
pub(super) struct Collector {
    metres_per_unit: f64,
    max_points: u64,
    with_colors: bool,
    /// The first finite points, until `origin` is decided.
    probe: Vec<[f64; 3]>,
    settled: bool,
    cloud: PointCloud,
    dropped: u64,
    seen: u64,
}

impl Collector {
    pub fn new(options: &DecodeOptions) -> Self {
        Self {
            metres_per_unit: options.metres_per_unit,
            max_points: options.max_points,
            with_colors: false,
            probe: Vec::new(),
            settled: false,
            cloud: PointCloud::default(),
            dropped: 0,
            seen: 0,
        }
    }

    /// Told before the first point: how many the header declares, and whether they have colours.
    pub fn expect(&mut self, declared: u64, with_colors: bool) -> Result<(), DecodeError> {
        if declared > self.max_points {
            return Err(DecodeError::TooManyPoints { points: declared, limit: self.max_points });
        }
        self.with_colors = with_colors;
        let reserved = declared.min(MAX_RESERVED) as usize;
        self.cloud.points.reserve(reserved);
        self.cloud.colors.reserve(if with_colors { reserved } else { 0 });
        Ok(())
    }

    /// Takes one point in the file's unit. The colour is ignored unless [`Collector::expect`] announced colours.
    pub fn push(&mut self, position: [f64; 3], color: [u8; 3]) -> Result<(), DecodeError> {
        self.seen += 1;
        if self.seen > self.max_points {
            return Err(DecodeError::TooManyPoints { points: self.seen, limit: self.max_points });
        }
        let position = position.map(|x| x * self.metres_per_unit);
        if !position.iter().all(|x| x.abs() <= MAX_COORDINATE_M) {
            self.dropped += 1;
            return Ok(());
        }
        if self.with_colors {
            self.cloud.colors.push(color);
        }
        if self.settled {
            self.store(position);
        } else {
            self.probe.push(position);
            if self.probe.len() == PROBE_POINTS {
                self.settle();
            }
        }
        Ok(())
    }

    /// The cloud, and how many points were dropped.
    pub fn finish(mut self) -> Result<(PointCloud, u64), DecodeError> {
        self.settle();
        match (self.cloud.is_empty(), self.dropped) {
            (true, 0) => Err(DecodeError::NoPoints),
            (true, dropped) => Err(DecodeError::OnlyNonFinite { dropped }),
            (false, dropped) => Ok((self.cloud, dropped)),
        }
    }

    /// Decides the origin: the median of the first points in whole metres when it is far out, else zero. A median,
    /// because files with real coordinates often hold a few points at 0 0 0.
    fn settle(&mut self) {
        if self.settled {
            return;
        }
        self.settled = true;
        let probe = std::mem::take(&mut self.probe);
        if probe.is_empty() {
            return;
        }
        let median: [f64; 3] = std::array::from_fn(|axis| {
            let mut values: Vec<f64> = probe.iter().map(|p| p[axis]).collect();
            let middle = values.len() / 2;
            *values.select_nth_unstable_by(middle, f64::total_cmp).1
        });
        if median.iter().any(|x| x.abs() > FAR_M) {
            self.cloud.origin = median.map(f64::round);
        }
        for position in probe {
            self.store(position);
        }
    }

    fn store(&mut self, position: [f64; 3]) {
        let origin = self.cloud.origin;
        self.cloud.points.push(std::array::from_fn(|axis| (position[axis] - origin[axis]) as f32));
    }
}
