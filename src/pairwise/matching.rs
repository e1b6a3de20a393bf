//! Descriptor matching: mutual nearest neighbours by blocked matrix products, ranked by how clearly each stands out.

use multiversion::multiversion;

use crate::features::{Columns, DESCRIPTOR_LEN, PreparedScan};

/// Rows of the similarity matrix computed at a time: 12 x 2000 floats stay near until their bests are found.
const BLOCK: usize = 12;
/// Rows taken together into the columns' bests, so that those pass through the cache once for all of them.
const TOGETHER: usize = 4;
/// Less than any similarity that counts.
const NOTHING: f32 = -1.0;

/// Two keypoints that are each other's nearest in descriptor space.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Keypoint number in scan a.
    pub a: u16,
    /// Keypoint number in scan b.
    pub b: u16,
    /// How clearly it stands out: the product over both sides of (distance to the nearest / distance to the second), in
    /// [0, 1], smaller is clearer.
    pub ambiguity: f32,
}

/// The mutual nearest neighbours among the keypoints of two scans, clearest first, at most `limit`. Deterministic: ties are
/// broken by keypoint number.
#[must_use]
pub fn mutual_matches(a: &PreparedScan, b: &PreparedScan, limit: usize) -> Vec<Match> {
    mutual(&a.descriptors, &b.descriptors, limit)
}

/// The same of any descriptors, each [`DESCRIPTOR_LEN`] numbers; keypoint numbers count from the first given.
pub(super) fn mutual(a: &[f32], b: &[f32], limit: usize) -> Vec<Match> {
    let (rows, columns) = (a.len() / DESCRIPTOR_LEN, b.len() / DESCRIPTOR_LEN);
    if rows == 0 || columns == 0 {
        return Vec::new();
    }
    let mut by_column = Best::new(columns);
    let mut by_row: Vec<RowBest> = Vec::with_capacity(rows);
    let across = Columns::new(b);
    let mut block = vec![0.0_f32; BLOCK * across.stride()];
    let nothing = vec![NOTHING; columns];
    for (some, rows) in a.chunks(BLOCK * DESCRIPTOR_LEN).enumerate() {
        across.multiply(rows, &mut block);
        let height = rows.len() / DESCRIPTOR_LEN;
        for row in (0..height).step_by(TOGETHER) {
            let lines: [&[f32]; TOGETHER] = std::array::from_fn(|k| {
                let line = (row + k) * across.stride();
                if row + k < height { &block[line..line + columns] } else { &nothing }
            });
            by_row.extend(lines.iter().take(height - row).map(|line| RowBest::of(line)));
            by_column.update(lines, (some * BLOCK + row) as u32);
        }
    }
    let mut matches: Vec<Match> = Vec::with_capacity(rows.min(columns));
    for column in 0..columns {
        let (first, row) = (by_column.first[column], by_column.index[column] as usize);
        let RowBest { best, second, tied } = by_row[row];
        // The greatest of its column is the greatest of its row too, and if there are several, the first of them.
        if first > 0.0 && first == best && tied.is_none_or(|first_column| first_column == column) {
            let ambiguity = ratio(best, second) * ratio(first, by_column.second[column]);
            matches.push(Match { a: row as u16, b: column as u16, ambiguity });
        }
    }
    matches.sort_by(|x, y| x.ambiguity.total_cmp(&y.ambiguity).then(x.a.cmp(&y.a)));
    matches.truncate(limit);
    matches
}

/// Distance ratio of two similarities of unit vectors: |x - y|^2 = 2 - 2 x.y.
fn ratio(best: f32, second: f32) -> f32 {
    ((1.0 - best).max(0.0) / (1.0 - second).max(1e-6)).min(1.0).sqrt()
}

/// The two largest values of a row.
struct RowBest {
    best: f32,
    second: f32,
    /// Where several are the largest, the first of them. A single one is found from its column, without a search.
    tied: Option<usize>,
}

impl RowBest {
    fn of(line: &[f32]) -> Self {
        let (best, second) = top_two(line);
        let tied = if best == second { line.iter().position(|x| *x == best) } else { None };
        Self { best, second, tied }
    }
}

/// The two largest values of each column seen so far, and where the largest is.
struct Best {
    first: Vec<f32>,
    second: Vec<f32>,
    index: Vec<u32>,
}

impl Best {
    fn new(columns: usize) -> Self {
        Self { first: vec![NOTHING; columns], second: vec![NOTHING; columns], index: vec![0; columns] }
    }

    /// Takes rows in, of which the first has number `row`.
    fn update(&mut self, lines: [&[f32]; TOGETHER], row: u32) {
        update_columns(lines, row, &mut self.first, &mut self.second, &mut self.index);
    }
}

#[multiversion(targets("x86_64+avx512f", "x86_64+avx2", "aarch64+neon"))]
fn update_columns(
    [w, x, y, z]: [&[f32]; TOGETHER],
    row: u32,
    best: &mut [f32],
    second: &mut [f32],
    index: &mut [u32],
) {
    let n = best.len();
    let (w, x, y, z) = (&w[..n], &x[..n], &y[..n], &z[..n]);
    let (second, index) = (&mut second[..n], &mut index[..n]);
    for i in 0..n {
        let (mut top, mut next, mut at) = (best[i], second[i], index[i]);
        for (value, row) in [(w[i], row), (x[i], row + 1), (y[i], row + 2), (z[i], row + 3)] {
            let lower = if value < top { value } else { top };
            next = if lower > next { lower } else { next };
            at = if value > top { row } else { at };
            top = if value > top { value } else { top };
        }
        (best[i], second[i], index[i]) = (top, next, at);
    }
}

#[multiversion(targets("x86_64+avx512f", "x86_64+avx2", "aarch64+neon"))]
fn top_two(line: &[f32]) -> (f32, f32) {
    // So many that the comparisons of one chunk do not wait for those of the last.
    const LANES: usize = 64;
    let mut best = [NOTHING; LANES];
    let mut second = [NOTHING; LANES];
    let mut chunks = line.chunks_exact(LANES);
    for chunk in &mut chunks {
        for k in 0..LANES {
            let x = chunk[k];
            let lower = if x < best[k] { x } else { best[k] };
            second[k] = if lower > second[k] { lower } else { second[k] };
            best[k] = if x > best[k] { x } else { best[k] };
        }
    }
    // Halves onto each other, until one is left.
    let mut width = LANES;
    while width > 1 {
        width /= 2;
        for k in 0..width {
            let (x, y) = (best[k], best[k + width]);
            let (lower, upper) = if x < y { (x, y) } else { (y, x) };
            let next = if second[k] > second[k + width] { second[k] } else { second[k + width] };
            best[k] = upper;
            second[k] = if lower > next { lower } else { next };
        }
    }
    let mut top = (best[0], second[0]);
    for &x in chunks.remainder() {
        if x > top.0 {
            top = (x, top.0);
        } else if x > top.1 {
            top.1 = x;
        }
    }
    top
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_two_largest_are_found(line in prop::collection::vec(0.0..1.0f32, 2..200)) {
            let mut sorted = line.clone();
            sorted.sort_by(|a, b| b.total_cmp(a));
            prop_assert_eq!(top_two(&line), (sorted[0], sorted[1]));
        }

        #[test]
        fn columns_keep_their_two_largest(a in prop::collection::vec(0.0..1.0f32, 2..50)) {
            let mut best = Best::new(1);
            for (row, x) in a.chunks(TOGETHER).enumerate() {
                let lines = std::array::from_fn(|k| x.get(k).map_or(&[NOTHING][..], std::slice::from_ref));
                best.update(lines, (row * TOGETHER) as u32);
            }
            let mut sorted = a.clone();
            sorted.sort_by(|x, y| y.total_cmp(x));
            prop_assert_eq!((best.first[0], best.second[0]), (sorted[0], sorted[1]));
            prop_assert_eq!(a[best.index[0] as usize], sorted[0]);
        }
    }
}
