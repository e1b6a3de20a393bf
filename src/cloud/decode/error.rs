//! Why a file could not be decoded.

use super::Format;
use crate::control::Cancelled;

/// Why a file gave no points. Messages name the field, the line or the byte offset, and the limit.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// Zero bytes.
    #[error("the file is empty: it has no bytes")]
    Empty,
    /// The content is none of the formats we read.
    #[error(
        "the content is no PLY, PCD, XYZ or PTS file{}",
        looks_like.map(|what| format!("; it looks like {what}")).unwrap_or_default()
    )]
    UnknownFormat {
        /// What the first bytes are the mark of, where that is known.
        looks_like: Option<&'static str>,
    },
    /// A header that does not follow its format.
    #[error("the {format} header is malformed at line {line}: {reason}")]
    Header {
        /// The format of the file.
        format: Format,
        /// Counted from 1.
        line: u64,
        /// What is wrong.
        reason: String,
    },
    /// No end of the header within the limit.
    #[error("the {format} header does not end within {limit_bytes} bytes")]
    HeaderTooLong {
        /// The format of the file.
        format: Format,
        /// The longest header that is read.
        limit_bytes: u64,
    },
    /// No such element, property or field is declared.
    #[error("the {format} header declares no {field:?}")]
    MissingField {
        /// The format of the file.
        format: Format,
        /// The field that is needed.
        field: &'static str,
    },
    /// A needed field has a type that cannot be read.
    #[error("the field {field:?} is declared as {found}, but must be {expected}")]
    FieldType {
        /// The field.
        field: String,
        /// Its declared type.
        found: String,
        /// What it must be.
        expected: &'static str,
    },
    /// Two declarations of the header contradict each other.
    #[error("the header contradicts itself: {reason}")]
    Contradiction {
        /// Which declarations, with their values.
        reason: String,
    },
    /// More points than the caller allows.
    #[error("the file declares or holds {points} points, at most {limit} are accepted")]
    TooManyPoints {
        /// Declared by the header, or counted so far.
        points: u64,
        /// The caller's limit.
        limit: u64,
    },
    /// One record is larger than any real one.
    #[error("the header declares records of {bytes} bytes each, at most {limit} are accepted")]
    RecordTooLarge {
        /// Declared size.
        bytes: u64,
        /// The limit.
        limit: u64,
    },
    /// The file ends before the declared number of records.
    #[error("the file is truncated: {present} of {declared} {what} are present")]
    Truncated {
        /// What is counted: points, records of an element before them, or bytes of compressed data.
        what: &'static str,
        /// Declared by the header.
        declared: u64,
        /// Complete ones that are really there.
        present: u64,
    },
    /// The file holds more than its header declares.
    #[error("the header declares {declared} points, but more data follows at byte {offset}")]
    ExcessData {
        /// Declared by the header.
        declared: u64,
        /// Where the declared points end.
        offset: u64,
    },
    /// A text row with the wrong number of values.
    #[error("line {line} has {found} values, but {expected} are expected")]
    RowLength {
        /// Counted from 1.
        line: u64,
        /// Values that are there.
        found: usize,
        /// Values that must be there.
        expected: usize,
    },
    /// A text value that is no number.
    #[error("line {line}: {value:?} is no number for {field}{hint}")]
    Value {
        /// Counted from 1.
        line: u64,
        /// What the value is for.
        field: &'static str,
        /// The text, shortened.
        value: String,
        /// A likely cause, or empty.
        hint: &'static str,
    },
    /// Commas that may be separators or decimal marks.
    #[error(
        "line {line}: the commas may separate values or be decimal marks; separate the values by spaces or semicolons, \
         or name the columns in a first line"
    )]
    AmbiguousCommas {
        /// Counted from 1.
        line: u64,
    },
    /// A line longer than any real one.
    #[error("line {line} is longer than {limit_bytes} bytes")]
    LineTooLong {
        /// Counted from 1.
        line: u64,
        /// The limit.
        limit_bytes: u64,
    },
    /// Binary data where text is declared or expected.
    #[error("line {line} (from byte {offset}) is not text, though the file says it is")]
    NotText {
        /// Counted from 1.
        line: u64,
        /// Where the line begins.
        offset: u64,
    },
    /// Text where the header declares binary data.
    #[error("the header declares binary data, but text follows at byte {offset}")]
    TextForBinary {
        /// Where the payload begins.
        offset: u64,
    },
    /// LZF data that does not decompress to what is declared.
    #[error("the compressed data is corrupt at its byte {offset}: {reason}")]
    CorruptLzf {
        /// Within the compressed block.
        offset: u64,
        /// What is wrong.
        reason: &'static str,
    },
    /// A valid file without points.
    #[error("the file holds no points")]
    NoPoints,
    /// Points, but none of them usable.
    #[error("none of the {dropped} points is finite")]
    OnlyNonFinite {
        /// How many there were.
        dropped: u64,
    },
    /// The unit of length is no positive finite number.
    #[error("metres_per_unit must be a positive finite number, not {0}")]
    Unit(f64),
    /// Reading failed; the file itself may be good.
    #[error("reading failed: {0}")]
    Io(#[from] std::io::Error),
    /// The caller stopped the computation.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}
