//! Damage that knows a little of structure: numbers, words, lines and fields, besides bits and bytes.

use rand::RngExt;
use rand::seq::IndexedRandom;
use rand_pcg::Pcg64;

/// What inputs are made of.
pub struct Pool<'a> {
    /// Inputs that led somewhere.
    pub inputs: Vec<Vec<u8>>,
    /// Words of the format.
    pub dictionary: Vec<&'a [u8]>,
}

/// Numbers at which programs trip.
const NUMBERS: [&str; 30] = [
    "0",
    "-0",
    "1",
    "-1",
    "2",
    "7",
    "255",
    "256",
    "65535",
    "65536",
    "2147483647",
    "2147483648",
    "-2147483649",
    "4294967295",
    "4294967296",
    "9223372036854775807",
    "9223372036854775808",
    "18446744073709551615",
    "18446744073709551616",
    "1e308",
    "1e309",
    "-1e39",
    "1e-320",
    "nan",
    "-inf",
    "0x10",
    "1_0",
    "1,5",
    "+3",
    "0000000000000000000000000001",
];
const INTEGERS: [u64; 12] =
    [0, 1, 2, 127, 128, 255, 0x7fff, 0xffff, 0x7fff_ffff, 0xffff_ffff, 0x7fff_ffff_ffff_ffff, u64::MAX];
const SEPARATORS: &[u8] = b" \t\n\r,;:=\0\"'#-+.eE/";

/// Damages an input once.
pub fn mutate(input: &mut Vec<u8>, pool: &Pool<'_>, rng: &mut Pcg64) {
    match rng.random_range(0..16) {
        0 => {
            if let Some(byte) = any(input, rng) {
                *byte ^= 1 << rng.random_range(0..8);
            }
        }
        1 => {
            let new = rng.random();
            if let Some(byte) = any(input, rng) {
                *byte = new;
            }
        }
        2 => input.truncate(rng.random_range(0..=input.len())),
        3 => drop(input.drain(range(input.len(), rng))),
        4 => {
            let copy = input[range(input.len(), rng)].to_vec();
            insert(input, &copy, rng);
        }
        5 => {
            let other = pool.inputs.choose(rng).map_or(&[][..], Vec::as_slice);
            let piece = other[range(other.len(), rng)].to_vec();
            insert(input, &piece, rng);
        }
        6 => {
            // The head of one and the tail of another.
            let other = pool.inputs.choose(rng).map_or(&[][..], Vec::as_slice);
            input.truncate(rng.random_range(0..=input.len()));
            input.extend_from_slice(&other[rng.random_range(0..=other.len())..]);
        }
        7 | 8 => {
            let number = NUMBERS.choose(rng).unwrap_or(&"0");
            replace_token(input, number.as_bytes(), |b| b.is_ascii_digit(), rng);
        }
        9 => {
            if let Some(word) = pool.dictionary.choose(rng) {
                replace_token(input, word, |b| b.is_ascii_alphabetic(), rng);
            }
        }
        10 => {
            if let Some(word) = pool.dictionary.choose(rng) {
                insert(input, word, rng);
            }
        }
        11 => overwrite(input, rng),
        12 => lines(input, rng),
        13 => {
            let (from, to) = (separator(rng), separator(rng));
            let once = rng.random_bool(0.5);
            let mut places = input.iter_mut().filter(|b| **b == from);
            if once {
                places.next().into_iter().for_each(|b| *b = to);
            } else {
                places.for_each(|b| *b = to);
            }
        }
        14 => {
            let byte = separator(rng);
            insert(input, &[byte], rng);
        }
        _ => {
            // Many of the same.
            let run = vec![rng.random::<u8>(); 1 << rng.random_range(0..12)];
            insert(input, &run, rng);
        }
    }
}

fn any<'a>(input: &'a mut [u8], rng: &mut Pcg64) -> Option<&'a mut u8> {
    let len = input.len();
    input.get_mut(rng.random_range(0..len.max(1)))
}

/// A range, mostly short.
fn range(len: usize, rng: &mut Pcg64) -> std::ops::Range<usize> {
    let from = rng.random_range(0..=len);
    let most = if rng.random_bool(0.8) { 16 } else { len };
    from..(from + rng.random_range(0..=most)).min(len)
}

fn insert(input: &mut Vec<u8>, piece: &[u8], rng: &mut Pcg64) {
    let at = rng.random_range(0..=input.len());
    input.splice(at..at, piece.iter().copied());
}

fn separator(rng: &mut Pcg64) -> u8 {
    SEPARATORS.choose(rng).copied().unwrap_or(b' ')
}

/// Puts `word` in the place of a run of bytes that belong together and hold one that `counts`.
fn replace_token(input: &mut Vec<u8>, word: &[u8], counts: impl Fn(u8) -> bool, rng: &mut Pcg64) {
    let places: Vec<usize> =
        (0..input.len()).filter(|&i| counts(input[i]) && (i == 0 || !counts(input[i - 1]))).collect();
    let Some(&from) = places.choose(rng) else { return };
    let belongs = |b: &u8| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'-' | b'+' | b'_');
    let length = input[from..].iter().take_while(|b| belongs(b)).count();
    input.splice(from..from + length, word.iter().copied());
}

/// Writes an integer or a float at which programs trip over some bytes, in either byte order.
fn overwrite(input: &mut [u8], rng: &mut Pcg64) {
    let value = if rng.random_bool(0.3) {
        let floats = [f64::NAN, f64::INFINITY, f64::MAX, f64::MIN_POSITIVE, -1e300, 1e8];
        let float = floats.choose(rng).copied().unwrap_or(0.0);
        if rng.random_bool(0.5) { float.to_bits() } else { u64::from((float as f32).to_bits()) }
    } else {
        INTEGERS.choose(rng).copied().unwrap_or(0).wrapping_add(rng.random_range(0..3))
    };
    let width = [1, 2, 4, 8].choose(rng).copied().unwrap_or(1);
    let mut bytes = value.to_le_bytes()[..width].to_vec();
    if rng.random_bool(0.3) {
        bytes.reverse();
    }
    if input.len() >= width {
        let at = rng.random_range(0..=input.len() - width);
        input[at..at + width].copy_from_slice(&bytes);
    }
}

/// Deletes, doubles or swaps lines.
fn lines(input: &mut Vec<u8>, rng: &mut Pcg64) {
    let mut lines: Vec<Vec<u8>> = input.split_inclusive(|b| *b == b'\n').map(<[u8]>::to_vec).collect();
    if lines.is_empty() {
        return;
    }
    let (a, b) = (rng.random_range(0..lines.len()), rng.random_range(0..lines.len()));
    match rng.random_range(0..3) {
        0 => drop(lines.remove(a)),
        1 => lines.insert(b, lines[a].clone()),
        _ => lines.swap(a, b),
    }
    *input = lines.concat();
}
