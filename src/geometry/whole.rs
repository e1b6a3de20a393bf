//! Whole parts of many numbers at once.

/// From here to twice as far numbers in single precision are one apart, so that their last bits are a whole number.
const WHOLE_FROM: f32 = 8_388_608.0;
const LAST_BITS: u32 = (1 << 23) - 1;

/// The whole part of a number from 0 to below 2^23; of any other, some number below 2^23, for the caller to leave out. The language's own conversion, which also answers
/// for all others, takes one number at a time and so keeps loops from running on many at once.
#[inline]
#[must_use]
pub fn whole(x: f32) -> u32 {
    let rounded = (x + WHOLE_FROM) - WHOLE_FROM;
    let floor = if rounded > x { rounded - 1.0 } else { rounded };
    (floor + WHOLE_FROM).to_bits() & LAST_BITS
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn it_is_what_the_conversion_says(x in 0.0..8_388_608.0_f32, exponent in 0..30_i32) {
            let x = x / 2.0_f32.powi(exponent);
            for x in [x, x.floor(), x.next_up(), x.ceil().next_down()] {
                if (0.0..WHOLE_FROM).contains(&x) {
                    prop_assert_eq!(whole(x), x as u32);
                }
            }
        }
    }

    #[test]
    fn what_is_nothing_has_no_whole_part() {
        assert_eq!([0.0, -0.0, f32::MIN_POSITIVE, 1.0_f32.next_down()].map(whole), [0; 4]);
    }
}
