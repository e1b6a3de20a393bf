//! A scan as the service knows it: what was uploaded, how it is to be read, and how far it has come.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{JobId, Name, ProjectId, ScanId, Standing, Timestamp};

/// What the engine knows a scan by: 128 bits of the hash of its bytes and of how they are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ContentKey(pub u128);

/// How the bytes of an upload are to be read.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interpretation {
    /// Metres in one unit of the file's coordinates.
    pub metres_per_unit: f64,
    /// Where the sensor stood, in the scan's own frame, metres. `None`: as the file says, or its origin.
    pub sensor_position: Option<[f64; 3]>,
    /// Against gravity, in the scan's own frame, of any length. `None`: nobody said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub up: Option<[f64; 3]>,
}

/// Why an interpretation is refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum BadInterpretation {
    /// No usable scale.
    #[error("one unit is {0} m; it must lie between 0.000001 and 1000000 m")]
    Units(f64),
    /// A coordinate is no number, or farther away than any scan.
    #[error(
        "a coordinate of the sensor position is {0} m; it must be finite and at most 10000000 m from zero"
    )]
    SensorPosition(f64),
    /// No direction.
    #[error("`up` is {0:?}; it must be three finite numbers whose length lies between 0.001 and 1000")]
    Up([f64; 3]),
}

impl Default for Interpretation {
    fn default() -> Self {
        Self { metres_per_unit: 1.0, sensor_position: None, up: None }
    }
}

impl Interpretation {
    /// Checks that every number makes sense.
    pub fn validate(&self) -> Result<(), BadInterpretation> {
        if !(1e-6..=1e6).contains(&self.metres_per_unit) {
            return Err(BadInterpretation::Units(self.metres_per_unit));
        }
        if let Some(x) = self.sensor_position.iter().flatten().find(|x| !x.is_finite() || x.abs() > 1e7) {
            return Err(BadInterpretation::SensorPosition(*x));
        }
        let length = |up: &[f64; 3]| up.iter().map(|x| x * x).sum::<f64>().sqrt();
        match self.up.filter(|up| !(1e-3..=1e3).contains(&length(up))) {
            Some(up) => Err(BadInterpretation::Up(up)),
            None => Ok(()),
        }
    }

    /// The same bytes for equal interpretations and different ones for others; none for the default.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        if *self == Self::default() {
            return Vec::new();
        }
        let sensor = self.sensor_position.iter().flatten();
        // Adding zero turns -0 into 0, which is equal to it and must give equal bytes.
        let bytes = |x: &f64| (x + 0.0).to_le_bytes();
        let mut all: Vec<u8> = std::iter::once(&self.metres_per_unit).chain(sensor).flat_map(bytes).collect();
        if let Some(up) = &self.up {
            all.extend_from_slice(b"up");
            all.extend(up.iter().flat_map(bytes));
        }
        all
    }
}

/// Reads `x,y,z`.
#[must_use]
pub fn three_numbers(text: &str) -> Option<[f64; 3]> {
    let numbers: Vec<f64> = text.split(',').map(|t| t.trim().parse().ok()).collect::<Option<_>>()?;
    numbers.try_into().ok()
}

/// How far a scan has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ScanState {
    /// Its bytes are safe; nothing was computed yet.
    Received,
    /// Decoded and prepared; it waits for its turn in the mapper.
    Ingested,
    /// In a component of the model.
    Registered,
    /// In the model, but in no component yet; it is tried again whenever the model grows.
    Waiting,
    /// It cannot be read or is not fit for registration.
    Failed,
    /// Its job was dismissed before it was registered.
    Dismissed,
}

impl ScanState {
    /// The word that is stored and shown.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Received => "received",
            Self::Ingested => "ingested",
            Self::Registered => "registered",
            Self::Waiting => "waiting",
            Self::Failed => "failed",
            Self::Dismissed => "dismissed",
        }
    }

    /// The state of a word.
    #[must_use]
    pub fn from_word(word: &str) -> Option<Self> {
        [Self::Received, Self::Ingested, Self::Registered, Self::Waiting, Self::Failed, Self::Dismissed]
            .into_iter()
            .find(|s| s.as_str() == word)
    }
}

impl fmt::Display for ScanState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// One acknowledged upload.
#[derive(Debug, Clone, PartialEq)]
pub struct Scan {
    /// Its id.
    pub id: ScanId,
    /// The project that it belongs to.
    pub project: ProjectId,
    /// What the engine knows it by.
    pub key: ContentKey,
    /// What the client called it.
    pub name: Name,
    /// The file format, as recognised from the first bytes.
    pub format: String,
    /// BLAKE3 hash of the upload, in hexadecimal.
    pub blob: String,
    /// Size of the upload.
    pub bytes: u64,
    /// How the bytes are read.
    pub interpretation: Interpretation,
    /// How many scans of the project arrived before it.
    pub arrival: u64,
    /// How far it has come.
    pub state: ScanState,
    /// Where it stands in the newest version; why it failed; absent before that.
    pub standing: Option<Standing>,
    /// Points, once decoded.
    pub points: Option<u64>,
    /// Whether the points have colours, once decoded.
    pub colored: Option<bool>,
    /// Diagonal of the box that holds the middle 96 % of each coordinate, metres, once decoded.
    pub extent: Option<f64>,
    /// The job that registers it.
    pub job: JobId,
    /// When it was acknowledged.
    pub created: Timestamp,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn different_interpretations_give_different_bytes_and_the_default_gives_none() {
        let default = Interpretation::default();
        let feet = Interpretation { metres_per_unit: 0.3048, ..default };
        let origin = Interpretation { sensor_position: Some([0.0; 3]), ..default };
        let minus = Interpretation { sensor_position: Some([-0.0, 0.0, 0.0]), ..default };
        let upright = Interpretation { up: Some([0.0; 3]), ..default };
        assert!(default.to_bytes().is_empty());
        assert_ne!(feet.to_bytes(), origin.to_bytes());
        assert_ne!(upright.to_bytes(), origin.to_bytes());
        assert_eq!(origin.to_bytes(), minus.to_bytes());
    }

    #[test]
    fn a_direction_of_no_length_is_refused_and_what_was_stored_without_one_is_read() {
        let up = |up| Interpretation { up: Some(up), ..Interpretation::default() }.validate();
        assert_eq!(up([0.0, 0.0, 9.81]), Ok(()));
        for bad in [[0.0; 3], [f64::INFINITY, 0.0, 0.0], [0.0, 1e-9, 0.0]] {
            assert_eq!(up(bad), Err(BadInterpretation::Up(bad)));
        }
        assert!(up([f64::NAN, 0.0, 1.0]).is_err());
        let stored = r#"{"metres_per_unit":0.001,"sensor_position":null}"#;
        assert_eq!(serde_json::from_str::<Interpretation>(stored).unwrap().up, None);
    }

    #[test]
    fn words_of_states_round_trip() {
        for state in [ScanState::Received, ScanState::Waiting, ScanState::Dismissed] {
            assert_eq!(ScanState::from_word(state.as_str()), Some(state));
        }
        assert_eq!(ScanState::from_word("lost"), None);
    }
}
