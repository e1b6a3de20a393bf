//! Estimated (or true) poses of scans, as the JSON that registration tools exchange.

use std::collections::BTreeMap;

use serde_json::Value;

use crate::geometry::{Pose, PoseError};

/// Where one scan was placed.
#[derive(Debug, Clone, PartialEq)]
pub struct PlacedScan {
    /// Maps points of the scan into the model frame of its component. Metres.
    pub model_from_scan: Pose,
    /// The name of the component: poses of different components are in unrelated frames.
    pub component: String,
}

/// Poses by scan name; scans that were not registered are only counted.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Estimate {
    /// The registered scans.
    pub placed: BTreeMap<String, PlacedScan>,
    /// Names of scans with no pose or no component.
    pub unplaced: Vec<String>,
}

/// Why a text is no estimate.
#[derive(Debug, thiserror::Error)]
pub enum EstimateError {
    /// No JSON.
    #[error("the poses are no valid JSON: {0}")]
    Json(#[from] serde_json::Error),
    /// Neither an object nor an array.
    #[error("the poses are neither an object of scans nor an array of entries")]
    Layout,
    /// An entry of an array without a name.
    #[error("entry {index} has neither a \"name\" nor a \"scan\" that is a text")]
    Nameless {
        /// Counted from 0.
        index: usize,
    },
    /// A pose that is no 4x4 matrix of numbers.
    #[error("the pose of {name:?} is no 4x4 matrix of numbers")]
    Matrix {
        /// The scan.
        name: String,
    },
    /// A matrix that is no rigid motion.
    #[error("the pose of {name:?} is no rigid motion: {source}")]
    Pose {
        /// The scan.
        name: String,
        /// Why.
        source: PoseError,
    },
}

impl Estimate {
    /// Parses any of the layouts in use:
    ///
    /// - `{"name": 4x4, …}`, all in one component;
    /// - `{"scans": {"name": {"pose": 4x4 or null, "component": id or null}, …}, …}`, or the inner object alone, or `model`
    ///   for `component`;
    /// - `[{"name": …, "pose": …, "component": …}, …]`, or `scan` for `name`, or this array as `scans`.
    ///
    /// Matrices are row-major, nested or flat. Without a component, a scan is in component 0.
    ///
    /// # Errors
    /// [`EstimateError`] names the scan.
    ///
    /// ```
    /// use cairn::evaluate::Estimate;
    /// let json = r#"{"a.ply": [[1,0,0,5],[0,1,0,0],[0,0,1,0],[0,0,0,1]], "b.ply": null}"#;
    /// let estimate = Estimate::parse(json)?;
    /// assert_eq!(estimate.placed["a.ply"].model_from_scan.translation.x, 5.0);
    /// assert_eq!(estimate.unplaced, ["b.ply"]);
    /// # Ok::<(), cairn::evaluate::EstimateError>(())
    /// ```
    pub fn parse(json: &str) -> Result<Self, EstimateError> {
        let document: Value = serde_json::from_str(json)?;
        let body = document.get("scans").unwrap_or(&document);
        let mut estimate = Self::default();
        match body {
            Value::Object(scans) => {
                for (name, entry) in scans {
                    estimate.add(name, entry)?;
                }
            }
            Value::Array(entries) => {
                for (index, entry) in entries.iter().enumerate() {
                    let text = |key| entry.get(key).and_then(Value::as_str).filter(|name| !name.is_empty());
                    let name =
                        text("name").or_else(|| text("scan")).ok_or(EstimateError::Nameless { index })?;
                    estimate.add(name, entry)?;
                }
            }
            _ => return Err(EstimateError::Layout),
        }
        Ok(estimate)
    }

    /// The scan of this name; `.ply` is understood where either name has no extension.
    #[must_use]
    pub fn find(&self, name: &str) -> Option<&PlacedScan> {
        let with_ply = || self.placed.get(&format!("{name}.ply"));
        let without_ply = || name.strip_suffix(".ply").and_then(|stem| self.placed.get(stem));
        self.placed.get(name).or_else(with_ply).or_else(without_ply)
    }

    fn add(&mut self, name: &str, entry: &Value) -> Result<(), EstimateError> {
        let (pose, component) = match entry {
            Value::Object(fields) => {
                let component = fields.get("component").or_else(|| fields.get("model"));
                let component = match component {
                    Some(Value::Null) => None,
                    Some(Value::String(id)) => Some(id.clone()),
                    Some(id) => Some(id.to_string()),
                    None => Some("0".to_owned()),
                };
                (fields.get("pose").unwrap_or(&Value::Null), component)
            }
            matrix => (matrix, Some("0".to_owned())),
        };
        match component {
            Some(component) if !pose.is_null() => {
                let rows = matrix(pose).ok_or_else(|| EstimateError::Matrix { name: name.to_owned() })?;
                let model_from_scan = Pose::from_rows(&rows)
                    .map_err(|source| EstimateError::Pose { name: name.to_owned(), source })?;
                self.placed.insert(name.to_owned(), PlacedScan { model_from_scan, component });
            }
            _ => self.unplaced.push(name.to_owned()),
        }
        Ok(())
    }
}

/// Sixteen numbers, nested or flat.
fn matrix(value: &Value) -> Option<[[f64; 4]; 4]> {
    let mut numbers = Vec::with_capacity(16);
    for row in value.as_array()? {
        match row {
            Value::Array(row) if row.len() == 4 => {
                for number in row {
                    numbers.push(number.as_f64()?);
                }
            }
            number => numbers.push(number.as_f64()?),
        }
    }
    let numbers: [f64; 16] = numbers.try_into().ok()?;
    let mut rows = [[0.0; 4]; 4];
    for (row, values) in rows.iter_mut().zip(numbers.chunks_exact(4)) {
        row.copy_from_slice(values);
    }
    Some(rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MATRIX: &str = "[[1,0,0,2],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
    const FLAT: &str = "[1,0,0,2,0,1,0,0,0,0,1,0,0,0,0,1]";

    #[test]
    fn all_layouts_give_the_same_estimate() {
        for json in [
            format!(r#"{{"a.ply": {MATRIX}, "b.ply": null}}"#),
            format!(
                r#"{{"scans": {{"a.ply": {{"pose": {FLAT}, "component": 0}}, "b.ply": {{"pose": null}}}}}}"#
            ),
            format!(
                r#"{{"a.ply": {{"pose": {FLAT}, "model": 0}}, "b.ply": {{"pose": {FLAT}, "component": null}}}}"#
            ),
            format!(r#"[{{"name": "a.ply", "pose": {MATRIX}}}, {{"scan": "b.ply"}}]"#),
            format!(
                r#"{{"scans": [{{"name": "", "scan": "a.ply", "pose": {MATRIX}}}, {{"name": "b.ply"}}]}}"#
            ),
        ] {
            let estimate = Estimate::parse(&json).unwrap();
            assert_eq!(estimate.placed["a.ply"].model_from_scan.translation.x, 2.0, "{json}");
            assert_eq!(estimate.placed["a.ply"].component, "0");
            assert_eq!(estimate.unplaced, ["b.ply"]);
            assert!(estimate.find("a").is_some() && estimate.find("b").is_none());
        }
    }

    #[test]
    fn hostile_estimates_are_errors_that_name_the_scan() {
        assert!(matches!(Estimate::parse("{"), Err(EstimateError::Json(_))));
        assert!(matches!(Estimate::parse("7"), Err(EstimateError::Layout)));
        assert!(matches!(Estimate::parse("[{}]"), Err(EstimateError::Nameless { index: 0 })));
        for bad in ["[1,2]", "\"x\"", "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,\"0\",1]]"] {
            let error = Estimate::parse(&format!(r#"{{"a": {bad}}}"#)).unwrap_err();
            assert!(matches!(&error, EstimateError::Matrix { name } if name == "a"), "{error}");
        }
        let mirrored = r#"{"a": [[1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]}"#;
        assert!(matches!(Estimate::parse(mirrored), Err(EstimateError::Pose { .. })));
    }
}
