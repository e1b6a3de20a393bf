//! The loop: take an input that led somewhere new, damage it, try it, and remember it if it led somewhere new again.
//!
//! Instead of measuring coverage it looks at the answer: a kind of error or a kind of result that was not there before is
//! progress, and its input is worth damaging further. That takes multi-step mutations into deep parsers, and needs no nightly compiler.

use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use crate::mutate::{Pool, mutate};
use crate::{corpus, machine};

/// Inputs of the short form.
const SHORT: u64 = 4000;
/// No input grows beyond this, unless one of the corpus is larger.
const MAX_BYTES: usize = 1 << 16;
/// An input that takes longer is reported while it runs: it may never end.
const PATIENCE: Duration = Duration::from_secs(20);
/// Inputs between two looks at the memory.
const LOOK: u64 = 64;
/// Answers that are told apart, at most: enough for progress, and bounded.
const MAX_KINDS: usize = 20_000;

/// Runs one parser. `check` gets an input, asserts what is promised for it, and returns the kind of the answer: texts that differ
/// only in numbers count as one.
pub fn fuzz(name: &str, dictionary: &[&str], check: fn(&[u8]) -> String) {
    let setting =
        |name: &str| std::env::var(name).ok().map(|text| text.parse::<u64>().expect("a whole number"));
    let minutes = setting("CAIRN_FUZZ_MINUTES");
    let mut rng = Pcg64::seed_from_u64(setting("CAIRN_FUZZ_SEED").unwrap_or(0));
    let mut pool =
        Pool { inputs: corpus::inputs(name), dictionary: dictionary.iter().map(|w| w.as_bytes()).collect() };
    let max_bytes = pool.inputs.iter().map(Vec::len).max().unwrap_or(0).max(MAX_BYTES);
    let watched = Watched::begin(name);
    let check = |input: &[u8]| watched.while_trying(input, || check(input));
    let mut kinds = BTreeSet::new();
    for input in pool.inputs.clone() {
        kinds.insert(kind(&attempt(name, &input, &check)));
    }
    let (start, known) = (machine::processor_time(), kinds.len());
    let elapsed = || machine::processor_time().saturating_sub(start);
    let (mut tried, mut slowest) = (0, (Duration::ZERO, Vec::new()));
    while minutes.map_or(tried < SHORT, |m| elapsed() < Duration::from_mins(m)) {
        let mut input = pool.inputs[rng.random_range(0..pool.inputs.len())].clone();
        for _ in 0..1 << rng.random_range(0..4) {
            mutate(&mut input, &pool, &mut rng);
        }
        input.truncate(max_bytes);
        let begun = Instant::now();
        let answer = attempt(name, &input, &check);
        if begun.elapsed() > slowest.0 {
            slowest = (begun.elapsed(), input.clone());
        }
        if kinds.len() < MAX_KINDS && kinds.insert(kind(&answer)) {
            if std::env::var_os("CAIRN_FUZZ_KEEP").is_some() && input.len() < 2048 {
                corpus::keep(name, &input);
            }
            pool.inputs.push(input);
        }
        tried += 1;
        if tried % LOOK == 0 {
            machine::check(name);
        }
    }
    println!(
        "{name}: {tried} inputs in {:.0} CPU s, {known} kinds of answers of the corpus, {} in the end; the slowest took {:.1} ms ({} bytes)",
        elapsed().as_secs_f64(),
        kinds.len(),
        slowest.0.as_secs_f64() * 1e3,
        slowest.1.len(),
    );
}

/// Tries one input. If it breaks a promise, it is kept where the message says.
fn attempt(name: &str, input: &[u8], check: &impl Fn(&[u8]) -> String) -> String {
    catch_unwind(AssertUnwindSafe(|| check(input))).unwrap_or_else(|fault| {
        eprintln!("the input is in {}", put(name, input).display());
        resume_unwind(fault)
    })
}

/// Writes an input where somebody can look at it.
fn put(name: &str, input: &[u8]) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("fuzz-{name}"));
    std::fs::create_dir_all(env!("CARGO_TARGET_TMPDIR")).expect("there should be a folder for inputs");
    std::fs::write(&path, input).expect("the input should be kept");
    path
}

/// What is being tried, seen by a thread that reports an input that takes too long.
struct Watched(Arc<Mutex<Option<Trial>>>);

/// Since when which input is being tried.
type Trial = (Instant, Vec<u8>);

impl Watched {
    fn begin(name: &str) -> Self {
        let shared = Arc::new(Mutex::new(None::<Trial>));
        let (seen, name) = (Arc::downgrade(&shared), name.to_owned());
        // It ends with the parser that it watches.
        thread::spawn(move || {
            while let Some(current) = seen.upgrade() {
                if let Some((since, input)) = &*lock(&current)
                    && since.elapsed() > PATIENCE
                {
                    eprintln!(
                        "{name}: one input takes {:?} so far; it is in {}",
                        since.elapsed(),
                        put(&name, input).display()
                    );
                }
                drop(current);
                thread::sleep(PATIENCE);
            }
        });
        Self(shared)
    }

    fn while_trying<T>(&self, input: &[u8], run: impl FnOnce() -> T) -> T {
        *lock(&self.0) = Some((Instant::now(), input.to_vec()));
        let result = run();
        *lock(&self.0) = None;
        result
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// An answer with every number and every quoted text made alike.
fn kind(answer: &str) -> String {
    let mut kind = String::new();
    for (i, part) in answer.split(['"', '`']).enumerate() {
        if i % 2 == 1 {
            kind.push('"');
        } else {
            kind.extend(part.chars().filter(|c| !c.is_ascii_digit()));
        }
    }
    kind
}
