//! What the pairs of a join say of it by themselves, whatever third scans add. Used by `join`.

use super::candidates::{Backing, Candidate};
use super::join::Refusal;
use super::options::MappingOptions;

/// Log-odds that the pairs of a join give it by themselves, together and without limit, at least, unless its support is all that any level asks: as much as
/// a firm pair is worth. Of 1,171 scans of simulated houses that several pairs placed right, 7 have less. …
const LEAST_ALONE: f64 = 4.0;
/// … And if one pair alone has a voice of its own, and support is not firm: one that turned a scan by 119 degrees has 4.8. Of 352 scans that one pair placed right,
/// 45 do not pass these two.
pub const LEAST_OF_ONE: f64 = 5.0;

/// Whether the pairs of a join hardly believe it by themselves, and its support is not all that any level asks. What one pair alone has a voice for must
/// be firm besides, or surer.
#[must_use]
pub fn hardly_believed(candidate: &Candidate, backing: Backing, options: &MappingOptions) -> Option<Refusal> {
    let own = candidate.members.iter().filter(|member| member.has_own_voice()).count();
    let support = candidate.support.min(backing.support);
    let needed = if own > 1 || support >= options.firm_support { LEAST_ALONE } else { LEAST_OF_ONE };
    let alone = candidate.alone();
    (alone < needed && support < options.most_support()).then_some(Refusal::Support { found: alone, needed })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::ScanKey;
    use crate::graph::SupportOptions;
    use crate::mapping::candidates::{CLUSTERS, candidates};
    use crate::mapping::component::Component;
    use crate::mapping::test_hall::Model;
    use crate::pairwise::{Evidence, Hypothesis, PairKey, PairResult};

    #[test]
    fn pairs_that_hardly_believe_it_make_no_join_and_one_that_is_not_firm_must_be_surer() {
        let (model, options) = (Model::new(2), MappingOptions::default());
        let refusal_of = |pairs: usize, logit: f64, support: f64, backed: f64| {
            let a_from_b = model.contradiction((1, 2), true).a_from_b;
            let result = PairResult {
                pair: PairKey::of(ScanKey(1), ScanKey(2)),
                matches: Vec::new(),
                hypotheses: vec![Hypothesis { a_from_b, evidence: Evidence::default(), logit }],
            };
            let mut graph = model.coarse();
            graph.add_results([result], &SupportOptions::default());
            let [a, b] = [1, 2].map(|key| Component::single(ScanKey(key)));
            let mut found = candidates(&graph, &a, &b, model.hall.resolution, &options, CLUSTERS);
            let one = found.remove(0);
            let candidate = Candidate { support, members: vec![one.members[0]; pairs], ..one };
            hardly_believed(&candidate, Backing { support: backed, edges: pairs }, &options)
        };
        assert_eq!(refusal_of(2, 2.1, 3.0, 3.0), None);
        assert_eq!(refusal_of(2, 1.9, 3.0, 3.0), Some(Refusal::Support { found: 3.8, needed: LEAST_ALONE }));
        let refusal = |logit, support, backed| refusal_of(1, logit, support, backed);
        assert_eq!(refusal(5.1, 3.0, 3.0), None);
        let weak = Some(Refusal::Support { found: 4.9, needed: LEAST_OF_ONE });
        assert_eq!(refusal(4.9, 3.9, 4.0), weak);
        assert_eq!(refusal(4.9, 4.0, 3.9), weak, "alignment left less");
        assert_eq!(refusal(4.9, 4.0, 4.0), None);
        assert_eq!(refusal(3.9, 4.0, 4.0), Some(Refusal::Support { found: 3.9, needed: LEAST_ALONE }));
        assert_eq!(refusal(3.9, 8.0, 8.0), None, "third scans say all that can be said");
    }
}
