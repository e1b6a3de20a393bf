//! Descriptor matching: mutual nearest neighbours by blocked matrix products, ranked by how clearly each stands out.

use multiversion::multiversion;

use super::products::{Columns, Rows, UNIT};
use crate::features::PreparedScan;

/// Rows of the similarity matrix computed at a time: 12 x 2000 numbers stay near until their bests are found.
const BLOCK: usize = 12;
/// Rows taken together into the columns' bests, so that those pass through the cache once for all of them.
const TOGETHER: usize = 4;
/// Less than any similarity that counts.
const NOTHING: i16 = -1;

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
    let (rows, columns) = (Rows::new(a), Rows::new(b));
    let (height, width) = (rows.len(), columns.len());
    if height == 0 || width == 0 {
        return Vec::new();
    }
    let mut by_column = Best::new(width);
    let mut by_row: Vec<RowBest> = Vec::with_capacity(height);
    let across = Columns::new(&columns);
    let stride = across.stride();
    let mut block = vec![0_i16; BLOCK * stride];
    let nothing = vec![NOTHING; width];
    for first in (0..height).step_by(BLOCK) {
        let made = across.multiply(&rows, first, &mut block);
        for row in (0..made).step_by(TOGETHER) {
            let lines: [&[i16]; TOGETHER] = std::array::from_fn(|k| {
                let line = (row + k) * stride;
                if row + k < made { &block[line..line + width] } else { &nothing }
            });
            by_row.extend(lines.iter().take(made - row).map(|line| RowBest::of(line)));
            by_column.update(lines, (first + row) as u16);
        }
    }
    let mut matches: Vec<Match> = Vec::with_capacity(height.min(width));
    for column in 0..width {
        let (first, row) = (by_column.first[column], by_column.index[column] as usize);
        let RowBest { best, second, tied } = by_row[row];
        // The greatest of its column is the greatest of its row too, and if there are several, the first of them.
        if first > 0 && first == best && tied.is_none_or(|first_column| first_column == column) {
            let ambiguity = ratio(best, second) * ratio(first, by_column.second[column]);
            matches.push(Match { a: row as u16, b: column as u16, ambiguity });
        }
    }
    matches.sort_by(|x, y| x.ambiguity.total_cmp(&y.ambiguity).then(x.a.cmp(&y.a)));
    matches.truncate(limit);
    matches
}

/// Distance ratio of two similarities of unit vectors: |x - y|^2 = 2 - 2 x.y. Of what is too near to tell apart, neither is nearer.
fn ratio(best: i16, second: i16) -> f32 {
    let square = |similarity: i16| (UNIT - f32::from(similarity)).max(1.0);
    (square(best) / square(second)).min(1.0).sqrt()
}

/// The two largest values of a row.
struct RowBest {
    best: i16,
    second: i16,
    /// Where several are the largest, the first of them. A single one is found from its column, without a search.
    tied: Option<usize>,
}

impl RowBest {
    fn of(line: &[i16]) -> Self {
        let (best, second) = top_two(line);
        let tied = if best == second { line.iter().position(|x| *x == best) } else { None };
        Self { best, second, tied }
    }
}

/// The two largest values of each column seen so far, and where the largest is.
struct Best {
    first: Vec<i16>,
    second: Vec<i16>,
    index: Vec<u16>,
}

impl Best {
    fn new(columns: usize) -> Self {
        Self { first: vec![NOTHING; columns], second: vec![NOTHING; columns], index: vec![0; columns] }
    }

    /// Takes rows in, of which the first has number `row`.
    fn update(&mut self, lines: [&[i16]; TOGETHER], row: u16) {
        update_columns(lines, row, &mut self.first, &mut self.second, &mut self.index);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw", "x86_64+avx2", "aarch64+neon"))]
fn update_columns(
    [w, x, y, z]: [&[i16]; TOGETHER],
    row: u16,
    best: &mut [i16],
    second: &mut [i16],
    index: &mut [u16],
) {
    let n = best.len();
    let (w, x, y, z) = (&w[..n], &x[..n], &y[..n], &z[..n]);
    let (second, index) = (&mut second[..n], &mut index[..n]);
    for i in 0..n {
        let (mut top, mut next, mut at) = (best[i], second[i], index[i]);
        for (value, further) in [(w[i], 0), (x[i], 1), (y[i], 2), (z[i], 3)] {
            let lower = if value < top { value } else { top };
            next = if lower > next { lower } else { next };
            at = if value > top { row.wrapping_add(further) } else { at };
            top = if value > top { value } else { top };
        }
        (best[i], second[i], index[i]) = (top, next, at);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw", "x86_64+avx2", "aarch64+neon"))]
fn top_two(line: &[i16]) -> (i16, i16) {
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
        fn the_two_largest_are_found(line in prop::collection::vec(0..i16::MAX, 2..200)) {
            let mut sorted = line.clone();
            sorted.sort_by(|a, b| b.cmp(a));
            prop_assert_eq!(top_two(&line), (sorted[0], sorted[1]));
        }

        #[test]
        fn columns_keep_their_two_largest(a in prop::collection::vec(0..i16::MAX, 2..50)) {
            let mut best = Best::new(1);
            for (row, x) in a.chunks(TOGETHER).enumerate() {
                let lines = std::array::from_fn(|k| x.get(k).map_or(&[NOTHING][..], std::slice::from_ref));
                best.update(lines, (row * TOGETHER) as u16);
            }
            let mut sorted = a.clone();
            sorted.sort_by(|x, y| y.cmp(x));
            prop_assert_eq!((best.first[0], best.second[0]), (sorted[0], sorted[1]));
            prop_assert_eq!(a[best.index[0] as usize], sorted[0]);
        }
    }
}
