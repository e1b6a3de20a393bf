//! LZF decompression (Marc Lehmann's format), as PCD's `binary_compressed` uses it.
//!
//! `pcd-rs` has a decoder too, but it is private and allocates the declared size before it reads a byte.

use super::DecodeError;

/// A back reference of three bytes yields at most 264 bytes: nothing compresses better.
const MAX_RATIO: u64 = 264 / 3;

/// Decompresses `input`, which must give exactly `expected` bytes. Memory grows only as output is produced.
pub(super) fn decompress(input: &[u8], expected: u64) -> Result<Vec<u8>, DecodeError> {
    let corrupt = |offset: usize, reason| DecodeError::CorruptLzf { offset: offset as u64, reason };
    let attainable = (input.len() as u64).saturating_mul(MAX_RATIO);
    if expected > attainable {
        return Err(corrupt(input.len(), "this few bytes cannot hold the declared size"));
    }
    let mut out: Vec<u8> = Vec::with_capacity(expected.min(1 << 20) as usize);
    let mut at = 0;
    while let Some(&control) = input.get(at) {
        let start = at;
        at += 1;
        if control < 32 {
            let end = at + usize::from(control) + 1;
            let literal = input.get(at..end).ok_or(corrupt(start, "a literal run passes the end"))?;
            out.extend_from_slice(literal);
            at = end;
        } else {
            let mut next = || {
                let byte = input.get(at).copied().ok_or(corrupt(start, "a back reference is cut off"));
                at += 1;
                byte
            };
            let mut length = usize::from(control >> 5) + 2;
            if length == 9 {
                length += usize::from(next()?);
            }
            let distance = (usize::from(control & 0x1f) << 8) + usize::from(next()?) + 1;
            let from = out
                .len()
                .checked_sub(distance)
                .ok_or(corrupt(start, "a back reference points before the start"))?;
            if distance >= length {
                out.extend_from_within(from..from + length);
            } else {
                // The run overlaps what it appends to: byte by byte, so that it repeats itself.
                for offset in 0..length {
                    let byte = out.get(from + offset).copied().unwrap_or_default();
                    out.push(byte);
                }
            }
        }
        if out.len() as u64 > expected {
            return Err(corrupt(start, "it holds more than the declared size"));
        }
    }
    if (out.len() as u64) < expected {
        return Err(corrupt(input.len(), "it holds less than the declared size"));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn literals_and_overlapping_references_unfold() {
        // "ab", then 7 bytes from 2 back: the run repeats itself.
        assert_eq!(decompress(&[1, b'a', b'b', 5 << 5, 1], 9).unwrap(), b"ababababa");
        // A long reference: 7 + 3 + 2 bytes from 1 back.
        assert_eq!(decompress(&[0, b'x', 7 << 5, 3, 0], 13).unwrap(), [b'x'; 13]);
        assert_eq!(decompress(&[], 0).unwrap(), b"");
    }

    #[test]
    fn every_way_to_be_corrupt_is_an_error() {
        for (input, expected) in [
            (&[31, 1, 2][..], 32),        // literals cut off
            (&[0, b'a', 0x20, 9], 4),     // before the start
            (&[0, b'a', 0x20], 4),        // reference cut off
            (&[0, b'a', 0xe0], 4),        // length cut off
            (&[1, b'a', b'b'], 1),        // too much
            (&[1, b'a', b'b'], 3),        // too little
            (&[1, b'a', b'b'], u64::MAX), // a bomb's promise
        ] {
            assert!(matches!(decompress(input, expected), Err(DecodeError::CorruptLzf { .. })), "{input:?}");
        }
    }
}
