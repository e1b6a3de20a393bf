//! Similarities of many descriptors with many, in whole numbers of 16 bits: one instruction multiplies twice as many of them as in single precision, and
//! sums are exact, so that every processor comes to the same.

use pulp::NullaryFnOnce;

use crate::features::DESCRIPTOR_LEN;

/// What 1 is in a descriptor: so much less than 2^15 that the product of two unit vectors whose numbers are rounded is at most 2^30.
const ONE: f32 = 32_760.0;
/// Bits of a sum of products that a similarity leaves out.
const SHIFT: u32 = 15;
/// What 1 is in a similarity.
pub(super) const UNIT: f32 = ONE * ONE / (1 << SHIFT) as f32;

/// Two numbers of a descriptor, which are multiplied and added at once.
type Pair = [i16; 2];
const PAIRS: usize = DESCRIPTOR_LEN.div_ceil(2);
/// Columns that lie side by side: two vectors of the widest machine.
const WIDTH: usize = 32;
/// Rows and vectors of a tile: twelve sums at once, as many as small register files hold beside what is multiplied.
const ROWS: usize = 6;
const VECTORS: usize = 2;
/// Sums in a lane of 128 bits. Two vectors are shortened into one lane by lane in turns.
const TURN: usize = 4;

/// Some columns: for every pair of numbers two vectors of the widest machine.
type Panel = [[Side; VECTORS]; PAIRS];
type Side = [Pair; HALF];
const HALF: usize = WIDTH / VECTORS;

/// Descriptors in whole numbers, with a zero where the last pair is half empty.
#[derive(Debug, Clone)]
pub(super) struct Rows(Vec<[Pair; PAIRS]>);

/// Descriptors as columns of products: pair after pair of numbers for every 32 of them, zeros in place of those that are missing.
#[derive(Debug, Clone)]
pub(super) struct Columns(Vec<Panel>);

impl Rows {
    /// Of descriptors, each [`DESCRIPTOR_LEN`] numbers of a unit vector, one after the other.
    pub fn new(descriptors: &[f32]) -> Self {
        let of = |descriptor: &[f32; DESCRIPTOR_LEN]| {
            let mut row = [[0; 2]; PAIRS];
            for (number, x) in row.as_flattened_mut().iter_mut().zip(descriptor) {
                *number = (x * ONE).round() as i16;
            }
            row
        };
        Self(descriptors.as_chunks().0.iter().map(of).collect())
    }

    pub fn len(&self) -> usize {
        self.0.len()
    }
}

impl Columns {
    pub fn new(descriptors: &Rows) -> Self {
        let panel = |of: &[[Pair; PAIRS]]| {
            let mut panel = [[[[0; 2]; HALF]; VECTORS]; PAIRS];
            for (column, descriptor) in of.iter().enumerate() {
                let (turn, lane) = (column / TURN, column % TURN);
                for (panel, pair) in panel.iter_mut().zip(descriptor) {
                    panel[turn % VECTORS][turn / VECTORS * TURN + lane] = *pair;
                }
            }
            panel
        };
        Self(descriptors.0.chunks(WIDTH).map(panel).collect())
    }

    /// Numbers that a row of similarities takes: as many as there are descriptors, or some more, which are zero.
    pub fn stride(&self) -> usize {
        self.0.len() * WIDTH
    }

    /// The similarities of some descriptors, from the one called `first`, with these, a row of [`Columns::stride`] numbers for each, as far as
    /// there are descriptors and room. How many rows there are.
    pub fn multiply(&self, rows: &Rows, first: usize, products: &mut [i16]) -> usize {
        let stride = self.stride().max(1);
        let rows = &rows.0[first.min(rows.len())..];
        let rows = &rows[..rows.len().min(products.len() / stride)];
        let products = &mut products[..rows.len() * stride];
        dispatch(rows, &self.0, products);
        rows.len()
    }
}

fn dispatch(rows: &[[Pair; PAIRS]], columns: &[Panel], products: &mut [i16]) {
    #[cfg(target_arch = "x86_64")]
    {
        if let Some(vectors) = pulp::x86::V4::try_new() {
            return vectors.vectorize(Product { vectors, rows, columns, products });
        }
        if let Some(vectors) = pulp::x86::V3::try_new() {
            return vectors.vectorize(Product { vectors, rows, columns, products });
        }
    }
    Product { vectors: AnyMachine, rows, columns, products }.call();
}

/// Vectors of whole numbers.
trait Vectors: Copy {
    /// Columns of a vector.
    const LANES: usize;
    /// A pair of each column.
    type Pairs: Copy;
    /// A sum of each column.
    type Sums: Copy;

    fn zero(self) -> Self::Sums;
    fn splat(self, pair: Pair) -> Self::Pairs;
    /// Of columns that lie side by side, the first [`Vectors::LANES`] or those after so many times as many.
    fn load(self, columns: &Side, part: usize) -> Self::Pairs;
    fn multiply_add(self, sums: Self::Sums, x: Self::Pairs, y: Self::Pairs) -> Self::Sums;
    /// Writes the sums of two vectors, [`TURN`] from either in turns, without their last bits.
    fn store(self, sums: [Self::Sums; VECTORS], into: &mut [i16]);
}

/// What every compiler makes something of.
#[derive(Clone, Copy)]
struct AnyMachine;

impl Vectors for AnyMachine {
    const LANES: usize = 8;
    type Pairs = [Pair; 8];
    type Sums = [i32; 8];

    #[inline]
    fn zero(self) -> Self::Sums {
        [0; 8]
    }

    #[inline]
    fn splat(self, pair: Pair) -> Self::Pairs {
        [pair; 8]
    }

    #[inline]
    fn load(self, columns: &Side, part: usize) -> Self::Pairs {
        columns.as_chunks().0.get(part).copied().unwrap_or_default()
    }

    #[inline]
    fn multiply_add(self, sums: Self::Sums, x: Self::Pairs, y: Self::Pairs) -> Self::Sums {
        let product = |x: i16, y: i16| i32::from(x) * i32::from(y);
        std::array::from_fn(|lane| {
            let ([x, other_x], [y, other_y]) = (x[lane], y[lane]);
            sums[lane].wrapping_add(product(x, y).wrapping_add(product(other_x, other_y)))
        })
    }

    #[inline]
    fn store(self, sums: [Self::Sums; VECTORS], into: &mut [i16]) {
        for (turn, into) in into.chunks_exact_mut(TURN).enumerate() {
            let from = &sums[turn % VECTORS][turn / VECTORS * TURN..];
            for (into, sum) in into.iter_mut().zip(from) {
                *into = (sum >> SHIFT).clamp(i16::MIN.into(), i16::MAX.into()) as i16;
            }
        }
    }
}

/// Names the instructions of a machine.
#[cfg(target_arch = "x86_64")]
macro_rules! vectors {
    ($machine:ty, $lanes:literal, $pairs:ty, $sums:ty, $splat:ident, $products:ident, $add:ident, $shift:ident, $shorten:ident) => {
        impl Vectors for $machine {
            const LANES: usize = $lanes;
            type Pairs = $pairs;
            type Sums = $sums;

            #[inline(always)]
            fn zero(self) -> Self::Sums {
                self.$splat(0)
            }

            #[inline(always)]
            fn splat(self, pair: Pair) -> Self::Pairs {
                pulp::cast(self.$splat(pulp::cast(pair)))
            }

            #[inline(always)]
            fn load(self, columns: &Side, part: usize) -> Self::Pairs {
                let parts = columns.as_chunks::<$lanes>().0;
                pulp::cast(parts.get(part).copied().unwrap_or_default())
            }

            #[inline(always)]
            fn multiply_add(self, sums: Self::Sums, x: Self::Pairs, y: Self::Pairs) -> Self::Sums {
                self.$add(sums, self.$products(x, y))
            }

            #[inline(always)]
            fn store(self, [x, y]: [Self::Sums; VECTORS], into: &mut [i16]) {
                let short = self.$shorten(self.$shift::<{ SHIFT as _ }>(x), self.$shift::<{ SHIFT as _ }>(y));
                let short: [i16; 2 * $lanes] = pulp::cast(short);
                into[..2 * $lanes].copy_from_slice(&short);
            }
        }
    };
}

#[cfg(target_arch = "x86_64")]
vectors!(
    pulp::x86::V3,
    8,
    pulp::i16x16,
    pulp::i32x8,
    splat_i32x8,
    multiply_wrapping_add_adjacent_i16x16,
    wrapping_add_i32x8,
    shr_const_i32x8,
    pack_with_signed_saturation_i32x8
);
#[cfg(target_arch = "x86_64")]
vectors!(
    pulp::x86::V4,
    16,
    pulp::i16x32,
    pulp::i32x16,
    splat_i32x16,
    multiply_wrapping_add_adjacent_i16x32,
    wrapping_add_i32x16,
    shr_const_i32x16,
    pack_with_signed_saturation_i32x16
);

struct Product<'a, V> {
    vectors: V,
    rows: &'a [[Pair; PAIRS]],
    columns: &'a [Panel],
    products: &'a mut [i16],
}

impl<V: Vectors> NullaryFnOnce for Product<'_, V> {
    type Output = ();

    #[expect(
        clippy::inline_always,
        reason = "it must become part of what is compiled for the processor's vectors"
    )]
    #[inline(always)]
    fn call(self) {
        let stride = self.columns.len() * WIDTH;
        if stride == 0 {
            return;
        }
        let missing = [[0; 2]; PAIRS];
        for (rows, products) in self.rows.chunks(ROWS).zip(self.products.chunks_mut(ROWS * stride)) {
            let rows: [&[Pair; PAIRS]; ROWS] = std::array::from_fn(|row| rows.get(row).unwrap_or(&missing));
            for (number, panel) in self.columns.iter().enumerate() {
                for part in 0..HALF / V::LANES {
                    let at = number * WIDTH + part * VECTORS * V::LANES;
                    let tile = tile(self.vectors, rows, panel, part);
                    for (line, sums) in products.chunks_exact_mut(stride).zip(tile) {
                        self.vectors.store(sums, &mut line[at..at + VECTORS * V::LANES]);
                    }
                }
            }
        }
    }
}

/// The products of some rows with two vectors of columns of a panel, one of some parts of them.
#[expect(
    clippy::inline_always,
    reason = "it must become part of what is compiled for the processor's vectors"
)]
#[inline(always)]
fn tile<V: Vectors>(
    vectors: V,
    rows: [&[Pair; PAIRS]; ROWS],
    panel: &Panel,
    part: usize,
) -> [[V::Sums; VECTORS]; ROWS] {
    let mut sums = [[vectors.zero(); VECTORS]; ROWS];
    for k in 0..PAIRS {
        let [x, y] = &panel[k];
        let columns = [vectors.load(x, part), vectors.load(y, part)];
        for (sums, row) in sums.iter_mut().zip(rows) {
            let same = vectors.splat(row[k]);
            for (sum, columns) in sums.iter_mut().zip(columns) {
                *sum = vectors.multiply_add(*sum, same, columns);
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn unit_vectors(most: usize) -> impl Strategy<Value = Vec<f32>> {
        prop::collection::vec(prop::array::uniform32(-1.0..1.0f32), 0..most).prop_map(|numbers| {
            let of = |x: [f32; 32]| {
                let length = x.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-3);
                x.into_iter().chain([0.1]).map(move |x| x / (length * length + 0.01).sqrt())
            };
            numbers.into_iter().flat_map(of).collect()
        })
    }

    fn all(rows: &Rows, columns: &Columns, by: impl Fn(&[[Pair; PAIRS]], &[Panel], &mut [i16])) -> Vec<i16> {
        let mut products = vec![i16::MIN; rows.len() * columns.stride()];
        by(&rows.0, &columns.0, &mut products);
        products
    }

    proptest! {
        #[test]
        fn every_row_is_multiplied_with_every_column(a in unit_vectors(20), b in unit_vectors(100)) {
            let (rows, columns) = (Rows::new(&a), Columns::new(&Rows::new(&b)));
            let products = all(&rows, &columns, dispatch);
            for (i, row) in a.chunks_exact(DESCRIPTOR_LEN).enumerate() {
                let line = &products[i * columns.stride()..(i + 1) * columns.stride()];
                let mut of = b.chunks_exact(DESCRIPTOR_LEN);
                for product in line {
                    let expected: f32 = of.next().map_or(0.0, |of| row.iter().zip(of).map(|(x, y)| x * y).sum());
                    let found = f32::from(*product) / UNIT;
                    prop_assert!((found - expected).abs() < 2e-4, "{found} is not {expected}");
                }
            }
        }

        #[test]
        fn every_machine_comes_to_the_same(a in unit_vectors(20), b in unit_vectors(100)) {
            let (rows, columns) = (Rows::new(&a), Columns::new(&Rows::new(&b)));
            let plainly = all(&rows, &columns, |rows, columns, products| {
                Product { vectors: AnyMachine, rows, columns, products }.call();
            });
            prop_assert_eq!(all(&rows, &columns, dispatch), plainly.clone());
            #[cfg(target_arch = "x86_64")]
            if let Some(vectors) = pulp::x86::V3::try_new() {
                let found = all(&rows, &columns, |rows, columns, products| {
                    vectors.vectorize(Product { vectors, rows, columns, products });
                });
                prop_assert_eq!(found, plainly);
            }
        }
    }

    #[test]
    fn what_is_no_unit_vector_does_no_harm() {
        let mut wild = [f32::NAN, f32::INFINITY, -1e30, 7.0].repeat(DESCRIPTOR_LEN);
        wild[..DESCRIPTOR_LEN].fill(-1e30);
        let rows = Rows::new(&wild);
        let columns = Columns::new(&rows);
        let plainly = all(&rows, &columns, |rows, columns, products| {
            Product { vectors: AnyMachine, rows, columns, products }.call();
        });
        assert_eq!(all(&rows, &columns, dispatch), plainly, "sums that overflow are alike, too");
        let mut products = vec![0; 4 * columns.stride()];
        assert_eq!(columns.multiply(&rows, 0, &mut products), 4);
        assert_eq!(columns.multiply(&rows, 3, &mut products), 1);
        assert_eq!(columns.multiply(&rows, 9, &mut products), 0);
        assert_eq!(Columns::new(&Rows::new(&[])).multiply(&rows, 0, &mut []), 0);
    }
}
