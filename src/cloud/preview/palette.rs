//! Colours that tell scans apart.

/// The colour of the scan with this index: hues a golden angle apart, so that neighbours in the list differ most, in three
/// lightnesses.
///
/// ```
/// assert_ne!(cairn::cloud::scan_color(0), cairn::cloud::scan_color(1));
/// ```
#[must_use]
pub fn scan_color(index: usize) -> [u8; 3] {
    const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;
    // Reduced first, so that large indices keep their precision; the palette repeats after so many scans.
    let turn = (index % 3600) as f64;
    let lightness = [0.76, 0.70, 0.82][index % 3];
    oklch(lightness, 0.115, 4.4 + turn * GOLDEN_ANGLE)
}

/// OKLCH (Ottosson 2020) to sRGB: lightness and chroma as the eye has them, hue in radians.
fn oklch(lightness: f64, chroma: f64, hue: f64) -> [u8; 3] {
    let (a, b) = (chroma * hue.cos(), chroma * hue.sin());
    let l = (lightness + 0.396_337_777_4 * a + 0.215_803_757_3 * b).powi(3);
    let m = (lightness - 0.105_561_345_8 * a - 0.063_854_172_8 * b).powi(3);
    let s = (lightness - 0.089_484_177_5 * a - 1.291_485_548 * b).powi(3);
    [
        4.076_741_662_1 * l - 3.307_711_591_3 * m + 0.230_969_929_2 * s,
        -1.268_438_004_6 * l + 2.609_757_401_1 * m - 0.341_319_396_5 * s,
        -0.004_196_086_3 * l - 0.703_418_614_7 * m + 1.707_614_701 * s,
    ]
    .map(|linear| {
        let linear = linear.clamp(0.0, 1.0);
        let encoded =
            if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
        (255.0 * encoded).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_dozen_colours_are_far_apart_and_none_is_pale() {
        let colors: Vec<[u8; 3]> = (0..12).map(scan_color).collect();
        for (i, a) in colors.iter().enumerate() {
            assert!(a.iter().any(|&c| c < 190), "{a:?} is pale");
            for b in colors.iter().skip(i + 1) {
                let apart: i32 = a.iter().zip(b).map(|(x, y)| (i32::from(*x) - i32::from(*y)).abs()).sum();
                assert!(apart > 30, "{a:?} and {b:?}");
            }
        }
    }
}
