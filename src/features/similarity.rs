//! Similarities of many descriptors with many: dot products, a tile of some rows and columns at a time whose sums stay in registers. In single precision, as
//! what they are multiplied with are not all descriptors; those of two scans are matched in whole numbers.

use pulp::{Arch, Simd, WithSimd};

use super::fpfh::DESCRIPTOR_LEN;

/// Columns that lie side by side. A vector of any machine goes into it twice or more.
const WIDTH: usize = 32;
/// Rows and vectors of a tile: twelve sums at once, as many as the smallest register files hold beside what is multiplied.
const ROWS: usize = 6;
const VECTORS: usize = 2;

/// Descriptors as columns of products: coordinate after coordinate for every 32 of them, zeros in place of those that are missing.
#[derive(Debug, Clone)]
pub struct Columns {
    panels: Vec<[[f32; WIDTH]; DESCRIPTOR_LEN]>,
}

impl Columns {
    /// Of descriptors, each [`DESCRIPTOR_LEN`] numbers, one after the other.
    #[must_use]
    pub fn new(descriptors: &[f32]) -> Self {
        let panel = |of: &[f32]| {
            let mut panel = [[0.0; WIDTH]; DESCRIPTOR_LEN];
            for (column, descriptor) in of.chunks_exact(DESCRIPTOR_LEN).enumerate() {
                for (k, x) in descriptor.iter().enumerate() {
                    panel[k][column] = *x;
                }
            }
            panel
        };
        Self { panels: descriptors.chunks(WIDTH * DESCRIPTOR_LEN).map(panel).collect() }
    }

    /// Numbers that a row of similarities takes: as many as there are descriptors, or some more, which are zero.
    #[must_use]
    pub fn stride(&self) -> usize {
        self.panels.len() * WIDTH
    }

    /// The dot products of other descriptors with these, a row of [`Columns::stride`] numbers for each of them.
    ///
    /// # Panics
    ///
    /// If `products` has no room for all.
    pub fn multiply(&self, rows: &[f32], products: &mut [f32]) {
        assert!(products.len() >= rows.len() / DESCRIPTOR_LEN * self.stride());
        Arch::new().dispatch(Product { rows, columns: self, products });
    }
}

struct Product<'a> {
    rows: &'a [f32],
    columns: &'a Columns,
    products: &'a mut [f32],
}

impl WithSimd for Product<'_> {
    type Output = ();

    #[expect(
        clippy::inline_always,
        reason = "it must become part of what is compiled for the processor's vectors"
    )]
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let stride = self.columns.stride();
        if stride == 0 {
            return;
        }
        let missing = [0.0; DESCRIPTOR_LEN];
        let groups = self.rows.chunks(ROWS * DESCRIPTOR_LEN).zip(self.products.chunks_mut(ROWS * stride));
        for (rows, products) in groups {
            let rows = rows.as_chunks::<DESCRIPTOR_LEN>().0;
            let rows: [&[f32; DESCRIPTOR_LEN]; ROWS] =
                std::array::from_fn(|row| rows.get(row).unwrap_or(&missing));
            for (number, panel) in self.columns.panels.iter().enumerate() {
                for first in (0..WIDTH).step_by(VECTORS * S::F32_LANES) {
                    let tile = tile(simd, rows, panel, first);
                    for (line, sums) in products.chunks_exact_mut(stride).zip(tile) {
                        let into = &mut line[number * WIDTH + first..];
                        for (into, sum) in S::as_mut_simd_f32s(into).0.iter_mut().zip(sums) {
                            *into = sum;
                        }
                    }
                }
            }
        }
    }
}

/// The products of some rows with the columns of a panel from the one called `first`.
#[expect(
    clippy::inline_always,
    reason = "it must become part of what is compiled for the processor's vectors"
)]
#[inline(always)]
fn tile<S: Simd>(
    simd: S,
    rows: [&[f32; DESCRIPTOR_LEN]; ROWS],
    panel: &[[f32; WIDTH]; DESCRIPTOR_LEN],
    first: usize,
) -> [[S::f32s; VECTORS]; ROWS] {
    let mut sums = [[simd.splat_f32s(0.0); VECTORS]; ROWS];
    for k in 0..DESCRIPTOR_LEN {
        let columns = &S::as_simd_f32s(&panel[k][first..]).0[..VECTORS];
        for (sums, row) in sums.iter_mut().zip(rows) {
            let x = simd.splat_f32s(row[k]);
            for (sum, column) in sums.iter_mut().zip(columns) {
                *sum = simd.mul_add_e_f32s(x, *column, *sum);
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn descriptors(most: usize) -> impl Strategy<Value = Vec<f32>> {
        prop::collection::vec(prop::array::uniform32(-1.0..1.0f32), 0..most).prop_map(|numbers| {
            numbers.iter().flat_map(|x| x.iter().copied().chain([x[0] * x[31]])).collect()
        })
    }

    proptest! {
        #[test]
        fn every_row_is_multiplied_with_every_column(rows in descriptors(20), columns in descriptors(100)) {
            let all = Columns::new(&columns);
            let mut products = vec![f32::NAN; rows.len() / DESCRIPTOR_LEN * all.stride()];
            all.multiply(&rows, &mut products);
            for (i, row) in rows.chunks_exact(DESCRIPTOR_LEN).enumerate() {
                let line = &products[i * all.stride()..(i + 1) * all.stride()];
                let mut of = columns.chunks_exact(DESCRIPTOR_LEN);
                for product in line {
                    let expected: f32 = of.next().map_or(0.0, |of| row.iter().zip(of).map(|(x, y)| x * y).sum());
                    prop_assert!((product - expected).abs() < 1e-5, "{product} is not {expected}");
                }
            }
        }
    }
}
