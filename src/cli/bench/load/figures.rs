//! Latencies, and the report.

use std::collections::BTreeMap;
use std::time::Duration;

use serde_json::{Value, json};

/// How long requests of one kind took.
#[derive(Debug, Clone, Default)]
pub(super) struct Latencies(Vec<Duration>);

impl Latencies {
    pub fn push(&mut self, latency: Duration) {
        self.0.push(latency);
    }

    /// The least latency that a part (0 to 1) of the requests did not exceed.
    pub fn quantile(&self, part: f64) -> Duration {
        let mut sorted = self.0.clone();
        sorted.sort_unstable();
        let at = (part * sorted.len() as f64).ceil() as usize;
        sorted.get(at.saturating_sub(1)).copied().unwrap_or_default()
    }

    /// Count, median, tail, milliseconds.
    pub fn report(&self) -> Value {
        let ms = |part| (self.quantile(part).as_secs_f64() * 1e5).round() / 100.0;
        json!({ "count": self.0.len(), "p50": ms(0.5), "p99": ms(0.99), "max": ms(1.0) })
    }
}

/// What happened to all requests of a crowd.
#[derive(Debug, Default)]
pub(super) struct Figures {
    by_kind: BTreeMap<&'static str, Latencies>,
    /// Answers that were no success, and requests without an answer.
    pub refused: BTreeMap<String, usize>,
}

/// The kind of request that is judged.
pub(super) const POLL: &str = "poll";

impl Figures {
    pub fn add(&mut self, kind: &'static str, latency: Duration) {
        self.by_kind.entry(kind).or_default().push(latency);
    }

    pub fn refuse(&mut self, what: String) {
        *self.refused.entry(what).or_default() += 1;
    }

    pub fn merge(&mut self, other: Self) {
        for (kind, latencies) in other.by_kind {
            self.by_kind.entry(kind).or_default().0.extend(latencies.0);
        }
        for (what, n) in other.refused {
            *self.refused.entry(what).or_default() += n;
        }
    }

    /// Polls of jobs.
    pub fn polls(&self) -> Latencies {
        self.by_kind.get(POLL).cloned().unwrap_or_default()
    }

    pub fn report(&self) -> Value {
        self.by_kind.iter().map(|(kind, latencies)| ((*kind).to_owned(), latencies.report())).collect()
    }
}

/// The middle one; 0 if there is none.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// The report for people: a line a figure.
pub(super) fn text(report: &Value) -> String {
    let Some(fields) = report.as_object() else { return String::new() };
    let mut lines = Vec::new();
    for (name, value) in fields {
        match value.as_object().filter(|inner| inner.values().any(Value::is_object)) {
            Some(inner) => lines.extend(inner.iter().map(|(kind, value)| format!("{name} {kind}: {value}"))),
            None => lines.push(format!("{name}: {value}")),
        }
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_sorted_latencies() {
        let mut latencies = Latencies::default();
        for ms in (1..=100).rev() {
            latencies.push(Duration::from_millis(ms));
        }
        assert_eq!(latencies.quantile(0.5), Duration::from_millis(50));
        assert_eq!(latencies.quantile(0.99), Duration::from_millis(99));
        assert_eq!(latencies.quantile(1.0), Duration::from_millis(100));
        assert_eq!(Latencies::default().quantile(0.5), Duration::ZERO);
        assert_eq!(median(vec![3.0, 1.0, 2.0]), 2.0);
    }
}
