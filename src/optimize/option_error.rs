//! An option that makes no sense, and the checks that say so. Used by the options of all adjustments in this layer.

/// An option that makes no sense.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("option {name} is {value}, but it must be {requirement}")]
pub struct OptionError {
    /// The field.
    pub name: &'static str,
    /// What it was.
    pub value: f64,
    /// What it may be.
    pub requirement: &'static str,
}

impl OptionError {
    /// Checks that a number is positive and finite.
    pub(super) fn positive(name: &'static str, value: f64) -> Result<(), Self> {
        let requirement = "positive and finite";
        if value > 0.0 && value.is_finite() { Ok(()) } else { Err(Self { name, value, requirement }) }
    }

    /// Checks that a number is at least zero and finite.
    pub(super) fn not_negative(name: &'static str, value: f64) -> Result<(), Self> {
        let requirement = "at least zero and finite";
        if value >= 0.0 && value.is_finite() { Ok(()) } else { Err(Self { name, value, requirement }) }
    }
}
