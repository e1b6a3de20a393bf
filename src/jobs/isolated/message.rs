//! What the service and the process of a job say to each other: a line each, the service's to the process's standard input, the answers
//! from its standard output. What was computed goes by the rows and blobs of the data directory.

use std::fmt::{self, Display};
use std::str::FromStr;

use crate::project::JobId;

/// What the service says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// Do this claimed job.
    Work {
        /// The job that leads the claim.
        job: JobId,
        /// The attempt that fences it.
        attempt: u32,
    },
    /// Let go of the job.
    Stop,
}

/// What a process answers to [`Order::Work`], once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Report {
    /// It is at the job no more; how that ended is in the rows.
    Done,
    /// It could not begin, for want of something that may be there again soon.
    NotNow,
}

/// A line that nobody says.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` means nothing between the service and the process of a job")]
pub struct Unintelligible(String);

impl Display for Order {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Work { job, attempt } => write!(f, "work {job} {attempt}"),
            Self::Stop => f.write_str("stop"),
        }
    }
}

impl FromStr for Order {
    type Err = Unintelligible;

    fn from_str(line: &str) -> Result<Self, Unintelligible> {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["stop"] => Some(Self::Stop),
            ["work", job, attempt] => {
                job.parse().ok().zip(attempt.parse().ok()).map(|(job, attempt)| Self::Work { job, attempt })
            }
            _ => None,
        }
        .ok_or_else(|| Unintelligible(line.to_owned()))
    }
}

impl Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Done => "done",
            Self::NotNow => "not-now",
        })
    }
}

impl FromStr for Report {
    type Err = Unintelligible;

    fn from_str(line: &str) -> Result<Self, Unintelligible> {
        let known = [Self::Done, Self::NotNow].into_iter().find(|report| report.to_string() == line.trim());
        known.ok_or_else(|| Unintelligible(line.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_said_is_understood() {
        let job = JobId::generate();
        for order in [Order::Work { job, attempt: 7 }, Order::Stop] {
            assert_eq!(order.to_string().parse(), Ok(order));
        }
        for report in [Report::Done, Report::NotNow] {
            assert_eq!(report.to_string().parse(), Ok(report));
        }
        for strange in ["", "work", "work x 1", "work 01ARZ3NDEKTSV4RRFFQ69G5FAV -1", "stop now"] {
            assert!(strange.parse::<Order>().is_err(), "{strange}");
            assert!(strange.parse::<Report>().is_err(), "{strange}");
        }
    }
}
