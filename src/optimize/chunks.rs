//! Parallel sums whose bits do not depend on the number of threads: the parts are fixed by the length alone.

use std::ops::Range;

use rayon::prelude::*;

/// Items a part holds at least; a smaller part costs more to hand out than to compute.
const LEAST: usize = 512;
/// Parts at most, which bounds the memory of partial sums on large problems.
const MOST_PARTS: usize = 64;

/// Applies `part` to consecutive ranges that cover `0..len`, on rayon's ambient pool, and returns the results in order.
pub(super) fn map_parts<T: Send>(len: usize, part: impl Fn(Range<usize>) -> T + Sync) -> Vec<T> {
    let size = len.div_ceil(MOST_PARTS).max(LEAST);
    (0..len.div_ceil(size)).into_par_iter().map(|k| part(k * size..((k + 1) * size).min(len))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_parts_cover_everything_once_and_in_order() {
        for len in [0, 1, LEAST, LEAST + 1, 100_003] {
            let parts = map_parts(len, Iterator::collect::<Vec<_>>);
            assert!(parts.len() <= MOST_PARTS);
            assert_eq!(parts.concat(), (0..len).collect::<Vec<_>>());
        }
    }
}
