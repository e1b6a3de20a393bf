//! What a person sees while the rigs upload: bars in a terminal, a line whenever something changed elsewhere.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar};

use super::survey::RIGS;
use crate::cli::progress::bar;

/// How things stand.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Standing {
    /// Scans to be uploaded, by rig.
    pub scans: [usize; RIGS],
    /// Scans that were uploaded or refused, by rig.
    pub uploaded: [usize; RIGS],
    /// Scans that the service has not come to yet.
    pub queued: usize,
    pub registered: usize,
    pub waiting: usize,
    pub failed: usize,
    pub components: usize,
    pub landmarks: usize,
}

/// Shows standings.
pub(super) enum Display {
    Nothing,
    Lines { since: Instant, last: Option<(Standing, Instant)> },
    Bars { all: MultiProgress, rigs: Vec<ProgressBar>, model: ProgressBar },
}

/// Plain lines are at least so far apart.
const LINE_EVERY: Duration = Duration::from_secs(1);

impl Display {
    /// Bars on a terminal, lines elsewhere, nothing if `quiet`; all on standard error.
    pub fn new(quiet: bool) -> Self {
        if quiet {
            return Self::Nothing;
        }
        if !std::io::stderr().is_terminal() {
            return Self::Lines { since: Instant::now(), last: None };
        }
        let all = MultiProgress::new();
        let rigs = (1..=RIGS)
            .map(|rig| all.add(bar("{prefix:<12} [{bar:40}] {pos}/{len}").with_prefix(format!("rig {rig}"))))
            .collect();
        let model = all.add(bar("{prefix:<12} [{bar:40}] {pos}/{len}  {msg}").with_prefix("registered"));
        Self::Bars { all, rigs, model }
    }

    /// Shows how things stand.
    pub fn show(&mut self, now: &Standing) {
        match self {
            Self::Nothing => {}
            Self::Lines { since, last } => {
                if last.as_ref().is_none_or(|(shown, at)| shown != now && at.elapsed() >= LINE_EVERY) {
                    *last = Some((*now, Instant::now()));
                    eprintln!("{:4.0} s  {}", since.elapsed().as_secs_f64(), now.line());
                }
            }
            Self::Bars { rigs, model, .. } => {
                for ((bar, done), total) in rigs.iter().zip(now.uploaded).zip(now.scans) {
                    bar.set_length(total as u64);
                    bar.set_position(done as u64);
                }
                model.set_length(now.scans.iter().sum::<usize>() as u64);
                model.set_position(now.registered as u64);
                model.set_message(now.words());
            }
        }
    }

    /// Says something, above the bars.
    pub fn say(&self, text: &str) {
        match self {
            Self::Nothing => {}
            Self::Lines { .. } => eprintln!("{text}"),
            Self::Bars { all, .. } => all.suspend(|| eprintln!("{text}")),
        }
    }

    /// Shows the last standing, and takes the bars off the screen.
    pub fn finish(&mut self, now: &Standing) {
        match self {
            Self::Lines { last, .. } if last.as_ref().is_some_and(|(shown, _)| shown != now) => *last = None,
            _ => {}
        }
        self.show(now);
        if let Self::Bars { all, .. } = self {
            // A bar that cannot be cleared stays on the screen; nothing follows from it.
            let _ = all.clear();
            eprintln!("{}", now.line());
        }
    }
}

impl Standing {
    fn line(&self) -> String {
        let (uploaded, scans): (usize, usize) = (self.uploaded.iter().sum(), self.scans.iter().sum());
        format!("uploaded {uploaded}/{scans}, registered {}, {}", self.registered, self.words())
    }

    fn words(&self) -> String {
        let Self { queued, waiting, failed, components, landmarks, .. } = self;
        let failed = if *failed > 0 { format!(", failed {failed}") } else { String::new() };
        format!("queue {queued}, waiting {waiting}{failed}, components {components}, landmarks {landmarks}")
    }
}
