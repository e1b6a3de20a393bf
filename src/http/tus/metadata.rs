//! `Upload-Metadata`: the parameters of a direct upload, as tus sends them.

use std::collections::BTreeMap;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use crate::http::Problem;
use crate::http::query::Params;
use crate::http::upload::{interpretation, name};
use crate::project::{Interpretation, Name, ProjectId};

const FIELD: &str = "upload-metadata";
/// The longest header that is kept, bytes.
const MAX_BYTES: usize = 8 * 1024;
/// What common clients add of themselves and nobody here needs.
const PASSED_OVER: [&str; 4] = ["filetype", "type", "relativePath", "lastModified"];

/// What an upload is about.
#[derive(Debug, Clone, PartialEq)]
pub struct Metadata {
    /// `project`: the project that will own the scan.
    pub project: ProjectId,
    /// `name`, or `filename` if that is not given: what the scan is called.
    pub name: Name,
    /// `units`, `sensor_position` and `up`: how the bytes are read.
    pub interpretation: Interpretation,
}

/// Reads the value of an `Upload-Metadata` header: pairs of a key and its value in base64, separated by commas. Keys
/// are those of the query of a direct upload, and `project`; one that nobody knows is refused, since it may be a
/// misspelled unit.
///
/// # Errors
/// A problem that names the key.
pub fn parse_metadata(text: &str) -> Result<Metadata, Problem> {
    let mut params = Params::from(pairs(text)?);
    let project = params
        .with("project", "the id of a project", |text| text.parse().ok())?
        .ok_or_else(|| Problem::invalid("project", "`project` is missing in the metadata"))?;
    for key in PASSED_OVER {
        params.text(key);
    }
    let file_name = params.text("filename");
    let metadata = Metadata {
        project,
        name: name(&mut params, file_name)?,
        interpretation: interpretation(&mut params)?,
    };
    params.finish()?;
    Ok(metadata)
}

fn pairs(text: &str) -> Result<BTreeMap<String, String>, Problem> {
    if text.len() > MAX_BYTES {
        let detail = format!("`{FIELD}` has {} bytes, at most {MAX_BYTES} are read", text.len());
        return Err(Problem { limit: Some(MAX_BYTES as u64), ..Problem::invalid(FIELD, detail) });
    }
    let mut pairs = BTreeMap::new();
    for pair in text.split(',').map(str::trim).filter(|p| !p.is_empty()) {
        let (key, value) = pair.split_once(' ').unwrap_or((pair, ""));
        let shown: String = key.chars().take(60).collect();
        let value = STANDARD.decode(value.trim()).ok().and_then(|bytes| String::from_utf8(bytes).ok());
        let value =
            value.ok_or_else(|| Problem::invalid(&shown, format!("`{shown}` is not UTF-8 in base64")))?;
        if pairs.insert(key.to_owned(), value).is_some() {
            return Err(Problem::invalid(&shown, format!("`{shown}` is given twice")));
        }
    }
    Ok(pairs)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn encoded(pairs: &[(&str, &str)]) -> String {
        let pairs: Vec<_> = pairs.iter().map(|(k, v)| format!("{k} {}", STANDARD.encode(v))).collect();
        pairs.join(",")
    }

    const PROJECT: (&str, &str) = ("project", "01ARZ3NDEKTSV4RRFFQ69G5FAV");

    #[test]
    fn metadata_says_what_the_query_of_a_direct_upload_says() {
        let text = encoded(&[PROJECT, ("filename", "Büro.ply"), ("units", "mm"), ("filetype", "model/ply")]);
        let metadata = parse_metadata(&text).unwrap();
        assert_eq!(metadata.name.as_str(), "Büro.ply");
        assert_eq!(metadata.interpretation.metres_per_unit, 0.001);
        let both = encoded(&[
            PROJECT,
            ("filename", "a.ply"),
            ("name", "b.ply"),
            ("sensor_position", "1,2,3"),
            ("up", "0,0,1"),
        ]);
        let metadata = parse_metadata(&both).unwrap();
        assert_eq!(metadata.name.as_str(), "b.ply");
        assert_eq!(metadata.interpretation.sensor_position, Some([1.0, 2.0, 3.0]));
        assert_eq!(metadata.interpretation.up, Some([0.0, 0.0, 1.0]));
    }

    #[test]
    fn bad_metadata_names_its_key() {
        for (text, field) in [
            (encoded(&[PROJECT]), "name"),
            (encoded(&[("name", "a.ply")]), "project"),
            (encoded(&[("project", "x"), ("name", "a.ply")]), "project"),
            (encoded(&[PROJECT, ("name", "a.ply"), ("unit", "mm")]), "unit"),
            (encoded(&[PROJECT, PROJECT]), "project"),
            ("name =".to_owned(), "name"),
            ("name /w==".to_owned(), "name"),
            ("x".repeat(MAX_BYTES + 1), FIELD),
        ] {
            assert_eq!(parse_metadata(&text).unwrap_err().field.as_deref(), Some(field), "{text:.80}");
        }
    }
}
