//! Points of one scan carried into another, and what they meet there: what dense evidence and alignment are both made of.
//!
//! Points go through in blocks, one array a coordinate, so that the arithmetic runs on many at once and the lookups between, which wait
//! for memory, do not wait for each other.

use std::cell::Cell;

use multiversion::multiversion;

use crate::features::Scan;
use crate::geometry::Pose;

/// Points of a block. Its arrays stay in the first-level cache.
pub(crate) const BLOCK: usize = 256;

/// The arithmetic goes over this many points at once; `len` is filled up to a multiple of it.
pub(super) const LANES: usize = 16;

/// One number a point of the block.
pub(crate) type Numbers = [f32; BLOCK];

/// A motion in single precision: rotation by rows, and translation in metres.
pub(crate) struct Motion {
    rotation: [[f32; 3]; 3],
    translation: [f32; 3],
}

impl Motion {
    /// Of a pose.
    pub fn of(pose: &Pose) -> Self {
        let rotation = pose.rotation.matrix();
        Self {
            rotation: std::array::from_fn(|i| std::array::from_fn(|j| rotation[(i, j)] as f32)),
            translation: std::array::from_fn(|k| pose.translation[k] as f32),
        }
    }
}

/// A block of points of one scan, carried into the frame of another. Beyond `len` the arrays hold nothing of meaning, except that
/// `square` is infinite there up to the next multiple of [`LANES`].
pub(crate) struct Contacts {
    /// Points of the block in use.
    pub len: usize,
    /// The carried points, metres.
    pub point: [Numbers; 3],
    /// Their turned normals.
    pub normal: [Numbers; 3],
    /// Normals of the points that they meet.
    pub surface: [Numbers; 3],
    /// From the points that they meet to them, metres.
    pub offset: [Numbers; 3],
    /// Square of its length; infinite where nothing is near.
    pub square: Numbers,
    found: [u32; BLOCK],
    apart: [Numbers; 3],
}

thread_local! {
    /// A block that nobody uses: a new one is more work than a look at a few points.
    static SPARE: Cell<Option<Box<Contacts>>> = const { Cell::new(None) };
}

/// Carries the points of `other`, every `stride`-th from `first`, into the frame of `scan`, and shows them block after block, each with the number of its
/// first point.
pub(crate) fn meet(
    scan: &Scan,
    other: &Scan,
    motion: &Motion,
    (first, stride): (usize, usize),
    mut show: impl FnMut(&mut Contacts, usize),
) {
    let mut block = SPARE.take().unwrap_or_else(|| Box::new(Contacts::new()));
    let mut at = first;
    while let Some(next) = block.fill(scan, other, motion, at, stride) {
        show(&mut block, at);
        at = next;
    }
    SPARE.set(Some(block));
}

impl Contacts {
    fn new() -> Self {
        const NONE: [Numbers; 3] = [[0.0; BLOCK]; 3];
        Self {
            len: 0,
            point: NONE,
            normal: NONE,
            surface: NONE,
            offset: NONE,
            square: [f32::INFINITY; BLOCK],
            found: [0; BLOCK],
            apart: NONE,
        }
    }

    /// The points that are not as near to what they meet as this, square metres; one array a coordinate.
    pub fn farther_than(&mut self, square: f32) -> [&[f32]; 3] {
        let mut len = 0;
        for i in 0..self.len {
            for k in 0..3 {
                self.apart[k][len] = self.point[k][i];
            }
            len += usize::from(self.square[i] >= square);
        }
        self.apart.each_ref().map(|axis| &axis[..len])
    }

    /// Which point of the scan a point of the block meets; of meaning only where `square` is finite.
    pub fn near(&self, at: usize) -> usize {
        self.found[at] as usize
    }

    /// Cosine between the turned normal of a point and that of the point it meets.
    pub fn agreement(&self, at: usize) -> f32 {
        (0..3).map(|k| self.surface[k][at] * self.normal[k][at]).sum()
    }

    /// `len`, filled up to a multiple of [`LANES`].
    pub fn lanes(&self) -> usize {
        self.len.next_multiple_of(LANES).min(BLOCK)
    }

    /// Fills the block with the next points of `other`, every `stride`-th from `first`, at most [`BLOCK`], and gives the first
    /// that has to follow; `None` when there are no more.
    fn fill(
        &mut self,
        scan: &Scan,
        other: &Scan,
        motion: &Motion,
        first: usize,
        stride: usize,
    ) -> Option<usize> {
        let last = scan.surfels.len().checked_sub(1)?;
        let surfels = other.surfels.get(first..)?.iter().step_by(stride);
        self.len = 0;
        for (i, surfel) in surfels.take(BLOCK).enumerate() {
            for k in 0..3 {
                self.point[k][i] = surfel.position[k];
                self.normal[k][i] = surfel.normal[k];
            }
            self.len = i + 1;
        }
        if self.len == 0 {
            return None;
        }
        let (used, lanes) = (self.len, self.lanes());
        // Nothing of an earlier scan is left where the arithmetic goes.
        for axis in
            [&mut self.point, &mut self.normal, &mut self.surface, &mut self.offset].into_iter().flatten()
        {
            axis[used..lanes].fill(0.0);
        }
        carry(&mut self.point, &mut self.normal, motion, lanes);
        let [x, y, z] = &self.point;
        scan.grid.nearest_of_all([&x[..used], &y[..used], &z[..used]], &mut self.found[..used]);
        for (i, found) in self.found[..used].iter_mut().enumerate() {
            let near = &scan.surfels[(*found as usize).min(last)];
            for k in 0..3 {
                self.offset[k][i] = near.position[k];
                self.surface[k][i] = near.normal[k];
            }
        }
        self.found[used..lanes].fill(u32::MAX);
        part(&self.point, &mut self.offset, &mut self.square, &self.found[..lanes], last as u32);
        Some(first + BLOCK * stride)
    }
}

/// Carries the first points and their normals.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn carry(point: &mut [Numbers; 3], normal: &mut [Numbers; 3], motion: &Motion, count: usize) {
    let Motion { rotation: r, translation: t } = motion;
    let [x, y, z] = point.each_mut().map(|axis| &mut axis[..count]);
    let [nx, ny, nz] = normal.each_mut().map(|axis| &mut axis[..count]);
    for i in 0..count {
        let (px, py, pz) = (x[i], y[i], z[i]);
        x[i] = r[0][0] * px + r[0][1] * py + r[0][2] * pz + t[0];
        y[i] = r[1][0] * px + r[1][1] * py + r[1][2] * pz + t[1];
        z[i] = r[2][0] * px + r[2][1] * py + r[2][2] * pz + t[2];
        let (px, py, pz) = (nx[i], ny[i], nz[i]);
        nx[i] = r[0][0] * px + r[0][1] * py + r[0][2] * pz;
        ny[i] = r[1][0] * px + r[1][1] * py + r[1][2] * pz;
        nz[i] = r[2][0] * px + r[2][1] * py + r[2][2] * pz;
    }
}

/// Turns targets into offsets, with their squares, as far as `found` goes.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn part(point: &[Numbers; 3], offset: &mut [Numbers; 3], square: &mut Numbers, found: &[u32], last: u32) {
    let n = found.len();
    let [x, y, z] = point.each_ref().map(|axis| &axis[..n]);
    let [dx, dy, dz] = offset.each_mut().map(|axis| &mut axis[..n]);
    let square = &mut square[..n];
    for i in 0..n {
        let d = [x[i] - dx[i], y[i] - dy[i], z[i] - dz[i]];
        let apart = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
        square[i] = if found[i] <= last { apart } else { f32::INFINITY };
        (dx[i], dy[i], dz[i]) = (d[0], d[1], d[2]);
    }
}
