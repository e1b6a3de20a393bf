//! What a decoder is told besides the bytes.

use super::DecodeError;

/// How a file is to be read.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DecodeOptions {
    /// Length of the file's unit in metres; see [`metres_per_unit`].
    pub metres_per_unit: f64,
    /// Files that declare or hold more points are refused.
    pub max_points: u64,
}

impl Default for DecodeOptions {
    /// Metres, and at most 200 million points.
    fn default() -> Self {
        Self { metres_per_unit: 1.0, max_points: 200_000_000 }
    }
}

impl DecodeOptions {
    pub(super) fn check(&self) -> Result<(), DecodeError> {
        let scale = self.metres_per_unit;
        if scale.is_finite() && scale > 0.0 { Ok(()) } else { Err(DecodeError::Unit(scale)) }
    }
}

/// The length in metres of a named unit (`m`, `cm`, `mm`, `km`, `in`, `ft`, `us-ft`) or of a positive finite number
/// of metres. `None` for anything else.
///
/// ```
/// use cairn::cloud::metres_per_unit;
/// assert_eq!(metres_per_unit("mm"), Some(0.001));
/// assert_eq!(metres_per_unit("0.0254"), Some(0.0254));
/// assert_eq!(metres_per_unit("furlong"), None);
/// ```
#[must_use]
pub fn metres_per_unit(name: &str) -> Option<f64> {
    match name.trim() {
        "m" => Some(1.0),
        "cm" => Some(0.01),
        "mm" => Some(0.001),
        "km" => Some(1000.0),
        "in" => Some(0.0254),
        "ft" => Some(0.3048),
        // The survey foot, by definition.
        "us-ft" => Some(1200.0 / 3937.0),
        number => number.parse().ok().filter(|scale: &f64| scale.is_finite() && *scale > 0.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_named_or_positive_finite_numbers() {
        assert_eq!(metres_per_unit("us-ft"), Some(0.304_800_609_601_219_2));
        assert_eq!(metres_per_unit(" 2.5 "), Some(2.5));
        for bad in ["", "0", "-1", "nan", "inf", "M", "1e999", "1,5"] {
            assert_eq!(metres_per_unit(bad), None, "{bad}");
        }
    }
}
