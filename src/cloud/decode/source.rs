//! A byte stream that knows where it is: bounded lines, blocks, skips, and a cancellation check now and then.

use std::io::{BufRead, Chain, Cursor, Read};

use super::DecodeError;
use crate::control::CancelToken;

/// No line of a real file is longer.
pub(super) const MAX_LINE_BYTES: u64 = 256 * 1024;

/// How many lines or blocks pass between two looks at the cancellation token.
const CHECK_EVERY: u32 = 1024;

/// Head (already read for sniffing) and rest of a file, as one stream.
pub(super) struct Source<'a> {
    inner: Chain<Cursor<Vec<u8>>, &'a mut dyn BufRead>,
    /// Bytes taken so far.
    pub offset: u64,
    /// Lines taken so far: the number, from 1, of the line last taken.
    pub line: u64,
    cancel: &'a CancelToken,
    until_check: u32,
}

impl<'a> Source<'a> {
    pub fn new(head: Vec<u8>, rest: &'a mut dyn BufRead, cancel: &'a CancelToken) -> Self {
        Self { inner: Cursor::new(head).chain(rest), offset: 0, line: 0, cancel, until_check: 0 }
    }

    /// Takes the next line into `line`, without its line break. False at the end of the file.
    pub fn next_line(&mut self, line: &mut Vec<u8>) -> Result<bool, DecodeError> {
        self.check()?;
        line.clear();
        let taken = (&mut self.inner).take(MAX_LINE_BYTES + 1).read_until(b'\n', line)? as u64;
        if taken == 0 {
            return Ok(false);
        }
        self.offset += taken;
        self.line += 1;
        if taken > MAX_LINE_BYTES {
            return Err(DecodeError::LineTooLong { line: self.line, limit_bytes: MAX_LINE_BYTES });
        }
        if line.last() == Some(&b'\n') {
            line.pop();
            if line.last() == Some(&b'\r') {
                line.pop();
            }
        }
        Ok(true)
    }

    /// Takes the next line that is not blank, as text. `None` at the end of the file.
    pub fn next_text_line<'b>(&mut self, line: &'b mut Vec<u8>) -> Result<Option<&'b str>, DecodeError> {
        loop {
            let start = self.offset;
            if !self.next_line(line)? {
                return Ok(None);
            }
            if line.trim_ascii().is_empty() {
                continue;
            }
            let not_text = DecodeError::NotText { line: self.line, offset: start };
            if line.iter().any(|&byte| byte < 0x20 && !byte.is_ascii_whitespace()) {
                return Err(not_text);
            }
            return std::str::from_utf8(line).map(Some).map_err(|_| not_text);
        }
    }

    /// Fills the front of `block` with as many bytes as there still are, and returns how many.
    pub fn fill(&mut self, block: &mut [u8]) -> Result<usize, DecodeError> {
        self.check()?;
        let mut filled = 0;
        while let Some(rest) = block.get_mut(filled..).filter(|rest| !rest.is_empty()) {
            match self.inner.read(rest) {
                Ok(0) => break,
                Ok(taken) => filled += taken,
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error.into()),
            }
        }
        self.offset += filled as u64;
        Ok(filled)
    }

    /// Takes exactly `N` bytes, or `None` where the file ends before.
    pub fn array<const N: usize>(&mut self) -> Result<Option<[u8; N]>, DecodeError> {
        let mut bytes = [0; N];
        Ok((self.fill(&mut bytes)? == N).then_some(bytes))
    }

    /// Appends at most `count` bytes to `out`, growing it only by what is really there; returns how many.
    pub fn append(&mut self, count: u64, out: &mut Vec<u8>) -> Result<u64, DecodeError> {
        let mut taken = 0;
        while taken < count {
            self.check()?;
            let step = (count - taken).min(1 << 20);
            let got = (&mut self.inner).take(step).read_to_end(out)? as u64;
            taken += got;
            if got < step {
                break;
            }
        }
        self.offset += taken;
        Ok(taken)
    }

    /// Passes over at most `count` bytes; returns how many there were.
    pub fn skip(&mut self, count: u64) -> Result<u64, DecodeError> {
        let mut skipped = 0;
        while skipped < count {
            self.check()?;
            let available = self.inner.fill_buf()?.len() as u64;
            if available == 0 {
                break;
            }
            let step = available.min(count - skipped);
            // A buffer's length fits in usize, and `step` is not longer.
            self.inner.consume(step as usize);
            skipped += step;
        }
        self.offset += skipped;
        Ok(skipped)
    }

    /// Whether at least `record_bytes` more bytes follow that are neither blank nor zero: data that the header did not
    /// declare, as opposed to a last line break or padding.
    pub fn has_excess(&mut self, record_bytes: u64) -> Result<bool, DecodeError> {
        let mut rest = Vec::new();
        let present = self.append(record_bytes.clamp(1, 1 << 20), &mut rest)?;
        Ok(present >= record_bytes && rest.iter().any(|&byte| byte != 0 && !byte.is_ascii_whitespace()))
    }

    fn check(&mut self) -> Result<(), DecodeError> {
        if self.until_check == 0 {
            self.until_check = CHECK_EVERY;
            self.cancel.check()?;
        }
        self.until_check -= 1;
        Ok(())
    }
}

/// Parses one number of a text file. Accepts what C's `printf` writes, NaN and infinities in Windows spelling too.
pub(super) fn number(token: &str, field: &'static str, line: u64) -> Result<f64, DecodeError> {
    if let Ok(value) = token.parse() {
        return Ok(value);
    }
    if ["1.#IND", "1.#QNAN", "1.#INF", "1.#SNAN"]
        .iter()
        .any(|odd| token.trim_start_matches(['-', '+']).starts_with(odd))
    {
        return Ok(f64::NAN);
    }
    let hint = if token.contains(',') { " (a decimal comma? write a point)" } else { "" };
    Err(DecodeError::Value { line, field, value: token.chars().take(40).collect(), hint })
}

/// Whether a block of what should be binary records is a text of numbers instead.
pub(super) fn is_number_text(block: &[u8]) -> bool {
    let sample = block.get(..512).unwrap_or(block);
    sample.iter().any(u8::is_ascii_whitespace)
        && sample.iter().any(u8::is_ascii_digit)
        && sample
            .iter()
            .all(|byte| byte.is_ascii_digit() || byte.is_ascii_whitespace() || b"+-.eEnaNifIF".contains(byte))
}
