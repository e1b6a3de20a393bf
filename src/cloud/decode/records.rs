//! Records of one fixed size, read in blocks.

use super::DecodeError;
use super::source::{Source, is_number_text};

/// No point of a real file is larger.
pub(super) const MAX_RECORD_BYTES: u64 = 1 << 20;

/// About how many bytes are read at once.
const BLOCK_BYTES: usize = 256 * 1024;

/// Calls `each` with `declared` records of `stride` bytes. `last` says that nothing is declared after them.
///
/// # Errors
/// `Truncated` where the file ends before, `TextForBinary` where the payload is a text of numbers, `RecordTooLarge`, and
/// whatever `each` returns.
pub(super) fn read_records(
    source: &mut Source<'_>,
    declared: u64,
    stride: u64,
    last: bool,
    mut each: impl FnMut(&[u8]) -> Result<(), DecodeError>,
) -> Result<(), DecodeError> {
    if stride > MAX_RECORD_BYTES {
        return Err(DecodeError::RecordTooLarge { bytes: stride, limit: MAX_RECORD_BYTES });
    }
    let payload = source.offset;
    let stride = (stride as usize).max(1);
    let per_block = (BLOCK_BYTES / stride).max(1);
    let mut block = vec![0; per_block * stride];
    let mut present = 0;
    while present < declared {
        let wanted = (declared - present).min(per_block as u64) as usize * stride;
        let filled = source.fill(block.get_mut(..wanted).unwrap_or_default())?;
        let filled = block.get(..filled).unwrap_or_default();
        if present == 0 && is_number_text(filled) {
            return Err(DecodeError::TextForBinary { offset: payload });
        }
        for record in filled.chunks_exact(stride) {
            each(record)?;
            present += 1;
        }
        if filled.len() < wanted {
            return Err(DecodeError::Truncated { what: "points", declared, present });
        }
    }
    if last && source.has_excess(stride as u64)? {
        return Err(DecodeError::ExcessData { declared, offset: payload + declared * stride as u64 });
    }
    Ok(())
}
