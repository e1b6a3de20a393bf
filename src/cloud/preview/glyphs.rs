//! The few signs that a scale bar needs, as 5 x 7 bitmaps.

use super::image::Image;

/// Pixels from one sign to the next, at scale 1.
const ADVANCE: usize = 6;

/// Seven rows of five bits, the leftmost the highest. A sign that is not here is blank.
fn rows(sign: char) -> [u8; 7] {
    match sign {
        '0' => [0x0e, 0x11, 0x13, 0x15, 0x19, 0x11, 0x0e],
        '1' => [0x04, 0x0c, 0x04, 0x04, 0x04, 0x04, 0x0e],
        '2' => [0x0e, 0x11, 0x01, 0x06, 0x08, 0x10, 0x1f],
        '3' => [0x1e, 0x01, 0x01, 0x0e, 0x01, 0x01, 0x1e],
        '4' => [0x02, 0x06, 0x0a, 0x12, 0x1f, 0x02, 0x02],
        '5' => [0x1f, 0x10, 0x1e, 0x01, 0x01, 0x11, 0x0e],
        '6' => [0x06, 0x08, 0x10, 0x1e, 0x11, 0x11, 0x0e],
        '7' => [0x1f, 0x01, 0x02, 0x04, 0x08, 0x08, 0x08],
        '8' => [0x0e, 0x11, 0x11, 0x0e, 0x11, 0x11, 0x0e],
        '9' => [0x0e, 0x11, 0x11, 0x0f, 0x01, 0x02, 0x0c],
        'm' => [0x00, 0x00, 0x1a, 0x15, 0x15, 0x15, 0x15],
        'c' => [0x00, 0x00, 0x0e, 0x10, 0x10, 0x11, 0x0e],
        'k' => [0x10, 0x10, 0x12, 0x14, 0x18, 0x14, 0x12],
        _ => [0; 7],
    }
}

/// Width of a text in pixels.
pub(super) fn text_width(text: &str, scale: usize) -> usize {
    (text.chars().count() * ADVANCE).saturating_sub(1) * scale
}

/// Writes a text with its upper left corner at `at`.
pub(super) fn draw_text(image: &mut Image, text: &str, at: [usize; 2], scale: usize, color: [u8; 3]) {
    for (index, sign) in text.chars().enumerate() {
        for (y, bits) in rows(sign).into_iter().enumerate() {
            for x in (0..5).filter(|x| bits >> (4 - x) & 1 == 1) {
                let corner = [at[0] + (index * ADVANCE + x) * scale, at[1] + y * scale];
                image.rectangle(corner, [scale; 2], color);
            }
        }
    }
}

/// The longest round length (1, 2 or 5 times a power of ten, metres) of at most `limit_m`, and its name.
pub(super) fn round_length(limit_m: f64) -> Option<(f64, String)> {
    if !(1e-3..=1e6).contains(&limit_m) {
        return None;
    }
    let decade = 10f64.powf(limit_m.log10().floor());
    let length =
        [5.0, 2.0, 1.0].into_iter().map(|k| k * decade).find(|&length| length <= limit_m * 1.000_001)?;
    let name = match length {
        l if l > 999.0 => format!("{:.0} km", l / 1e3),
        l if l > 0.999 => format!("{l:.0} m"),
        l if l > 0.009_99 => format!("{:.0} cm", l * 1e2),
        l => format!("{:.0} mm", l * 1e3),
    };
    Some((length, name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_are_round_and_named() {
        for (limit, name) in [(3.7, "2 m"), (0.051, "5 cm"), (1.0, "1 m"), (7300.0, "5 km"), (0.0049, "2 mm")]
        {
            assert_eq!(round_length(limit).unwrap().1, name);
        }
        assert_eq!(round_length(0.0), None);
        assert_eq!(round_length(f64::NAN), None);
    }
}
