//! The engine's reasons as stable words with the numbers behind them. Used for what versions and jobs tell, and by the command line.

use serde_json::{Map, Value, json};

use crate::mapping::{Refusal, WaitingReason};
use crate::project::Reason;

/// Why a scan waits. The engine's own serialisation is the word, or the word with the numbers.
#[must_use]
pub fn reason_of(reason: &WaitingReason) -> Reason {
    let unknown = Reason { reason: "unknown".to_owned(), numbers: Map::new() };
    match serde_json::to_value(reason) {
        Ok(Value::String(reason)) => Reason { reason, numbers: Map::new() },
        Ok(Value::Object(object)) => match object.into_iter().next() {
            Some((reason, Value::Object(numbers))) => Reason { reason, numbers },
            _ => unknown,
        },
        _ => unknown,
    }
}

/// Why a join was not made, in the words that waiting scans have where they mean the same.
#[must_use]
pub fn reason_of_refusal(refusal: &Refusal) -> Reason {
    let (word, numbers) = match *refusal {
        Refusal::Support { found, needed } => {
            ("too-little-support", json!({ "best_support": found, "needed": needed }))
        }
        Refusal::Rival { support, rival } | Refusal::Torn { support, rival } => {
            ("ambiguous", json!({ "best_support": support, "rival_support": rival }))
        }
        Refusal::Contradicted { against, agreeing } => {
            ("contradicted", json!({ "against": against, "agreeing": agreeing }))
        }
        Refusal::Violation { found, allowed } => {
            ("violates-free-space", json!({ "violation": found, "allowed": allowed }))
        }
        Refusal::Indistinct { found, needed } => {
            ("indistinct", json!({ "beyond_planes": found, "needed": needed }))
        }
        Refusal::Forbidden => ("forbidden", Value::Null),
        Refusal::SinglePair { support } => ("single-pair", json!({ "best_support": support })),
    };
    let numbers = if let Value::Object(numbers) = numbers { numbers } else { Map::new() };
    Reason { reason: word.to_owned(), numbers }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reason_keeps_its_word_and_its_numbers() {
        let reason = reason_of(&WaitingReason::Ambiguous { best_support: 3.0, rival_support: 2.5 });
        assert_eq!(reason.reason, "ambiguous");
        assert_eq!(reason.numbers.get("rival_support"), Some(&Value::from(2.5)));
        assert_eq!(reason_of(&WaitingReason::OnlyScan).reason, "only-scan");
    }

    #[test]
    fn joins_are_refused_in_the_words_in_which_scans_wait() {
        for (refusal, reason) in [
            (
                Refusal::Rival { support: 3.0, rival: 2.5 },
                WaitingReason::Ambiguous { best_support: 3.0, rival_support: 2.5 },
            ),
            (
                Refusal::Torn { support: 3.0, rival: 2.5 },
                WaitingReason::Ambiguous { best_support: 3.0, rival_support: 2.5 },
            ),
            (
                Refusal::Contradicted { against: 4, agreeing: 9 },
                WaitingReason::Contradicted { against: 4, agreeing: 9 },
            ),
            (
                Refusal::Violation { found: 0.3, allowed: 0.1 },
                WaitingReason::ViolatesFreeSpace { violation: 0.3, allowed: 0.1 },
            ),
            (
                Refusal::Indistinct { found: 0.02, needed: 0.05 },
                WaitingReason::Indistinct { beyond_planes: 0.02, needed: 0.05 },
            ),
            (Refusal::Forbidden, WaitingReason::Forbidden),
        ] {
            assert_eq!(reason_of_refusal(&refusal), reason_of(&reason));
        }
    }
}
