//! The formats we read, and how their content is told apart.

use serde::{Deserialize, Serialize};

use super::text::{self, FirstLine};

/// A file format of point clouds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// Polygon file format: ascii, binary little endian or binary big endian.
    Ply,
    /// Point Cloud Library: ascii, binary or binary compressed.
    Pcd,
    /// Text, a point a line: `x y z` and more columns.
    Xyz,
    /// Text as laser scanners export it: a line with the count, then `x y z intensity r g b`.
    Pts,
}

impl Format {
    /// The format that a file extension (without its dot, any case) usually means. Only a hint: [`sniff`] decides.
    #[must_use]
    pub fn from_extension(extension: &str) -> Option<Self> {
        match extension.to_ascii_lowercase().as_str() {
            "ply" => Some(Self::Ply),
            "pcd" => Some(Self::Pcd),
            "xyz" | "txt" | "asc" | "csv" => Some(Self::Xyz),
            "pts" => Some(Self::Pts),
            _ => None,
        }
    }

    /// The media type to send it as.
    #[must_use]
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Ply => "model/ply",
            Self::Pcd => "application/vnd.pcl.pcd",
            Self::Xyz | Self::Pts => "text/plain; charset=utf-8",
        }
    }
}

impl std::fmt::Display for Format {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::Ply => "PLY",
            Self::Pcd => "PCD",
            Self::Xyz => "XYZ",
            Self::Pts => "PTS",
        })
    }
}

/// Tells the format by the first bytes of a file (a few kilobytes are enough). A name is never looked at.
///
/// ```
/// use cairn::cloud::{Format, sniff};
/// assert_eq!(sniff(b"ply\nformat ascii 1.0\n"), Some(Format::Ply));
/// assert_eq!(sniff(b"1.0 2.0 3.0\n4 5 6\n"), Some(Format::Xyz));
/// assert_eq!(sniff(b"\x89PNG\r\n"), None);
/// ```
#[must_use]
pub fn sniff(head: &[u8]) -> Option<Format> {
    if head.starts_with(b"ply") && head.get(3).is_some_and(u8::is_ascii_whitespace) {
        return Some(Format::Ply);
    }
    if is_pcd(head) {
        return Some(Format::Pcd);
    }
    match text::first_line(head)? {
        FirstLine::Count => Some(Format::Pts),
        FirstLine::Columns | FirstLine::Row => Some(Format::Xyz),
    }
}

/// `# .PCD` is customary but optional: the first keyword after comments settles it.
fn is_pcd(head: &[u8]) -> bool {
    head.split(|&byte| byte == b'\n')
        .map(<[u8]>::trim_ascii)
        .find(|line| line.starts_with(b"# .PCD") || !(line.is_empty() || line.starts_with(b"#")))
        .is_some_and(|line| {
            line.starts_with(b"# .PCD")
                || [&b"VERSION"[..], b"FIELDS", b"COLUMNS"].iter().any(|key| {
                    line.strip_prefix(*key).and_then(<[u8]>::first).is_some_and(u8::is_ascii_whitespace)
                })
        })
}

/// The name of a well-known format whose mark the first bytes carry, for a helpful message.
pub(super) fn looks_like(head: &[u8]) -> Option<&'static str> {
    const MARKS: [(&[u8], &str); 13] = [
        (b"LASF", "a LAS or LAZ file"),
        (b"ASTM-E57", "an E57 file"),
        (b"\x89PNG", "a PNG picture"),
        (b"\xff\xd8\xff", "a JPEG picture"),
        (b"PK\x03\x04", "a ZIP archive"),
        (b"\x1f\x8b", "gzip-compressed data"),
        (b"7z\xbc\xaf", "a 7-Zip archive"),
        (b"%PDF", "a PDF document"),
        (b"solid", "an STL mesh"),
        (b"glTF", "a glTF model"),
        (b"\xff\xfe", "UTF-16 text; save it as UTF-8"),
        (b"\xfe\xff", "UTF-16 text; save it as UTF-8"),
        (b"<", "HTML or XML"),
    ];
    MARKS.iter().find(|(mark, _)| head.starts_with(mark)).map(|&(_, what)| what)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_content_decides_the_format() {
        assert_eq!(sniff(b"ply\r\nformat ascii 1.0\r\n"), Some(Format::Ply));
        assert_eq!(sniff(b"plywood\n"), None);
        assert_eq!(sniff(b"# .PCD v0.7 - Point Cloud Data\nVERSION 0.7\n"), Some(Format::Pcd));
        assert_eq!(sniff(b"# made by hand\n\nVERSION .7\nFIELDS x y z\n"), Some(Format::Pcd));
        assert_eq!(sniff(b"VERSIONS 1 2 3\n"), None);
        assert_eq!(sniff(b"\xef\xbb\xbf1;2;3\n"), Some(Format::Xyz));
        assert_eq!(sniff(b"# x y z\n1,2,3\n"), Some(Format::Xyz));
        assert_eq!(sniff(b"2\n1 2 3\n4 5 6\n"), Some(Format::Pts));
        assert_eq!(sniff(b"// only a comment\n"), None);
        assert_eq!(sniff(b"hello world\n"), None);
        assert_eq!(sniff(b"\0\0\0\0"), None);
        assert_eq!(sniff(b""), None);
    }

    #[test]
    fn an_extension_is_a_hint_in_any_case() {
        assert_eq!(Format::from_extension("PLY"), Some(Format::Ply));
        assert_eq!(Format::from_extension("las"), None);
    }
}
