//! Which poses an adjustment may move: the caller's held ones, one anchor a connected group, and none that nothing ties.

/// What stands still and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Gauge {
    /// A flag a pose: it does not move, for any of the reasons.
    pub held: Vec<bool>,
    /// Poses held because their connected group had no held one: the lowest index of each group.
    pub anchors: Vec<usize>,
    /// Poses that no link ties to anything: held too.
    pub unlinked: Vec<usize>,
}

impl Gauge {
    /// From the poses the caller holds, links between poses (indices in range), and poses tied to something fixed.
    pub(super) fn new(
        held: &[bool],
        links: impl Iterator<Item = (usize, usize)>,
        tied: impl Iterator<Item = usize>,
    ) -> Self {
        let mut groups = Groups((0..held.len()).collect());
        let mut linked = vec![false; held.len()];
        for (i, j) in links.filter(|(i, j)| i != j) {
            groups.join(i, j);
            linked[i] = true;
            linked[j] = true;
        }
        let mut fixed = held.to_vec();
        for i in tied {
            linked[i] = true;
            fixed[i] = true;
        }
        let mut anchored = vec![false; held.len()];
        for i in (0..held.len()).filter(|&i| fixed[i]) {
            anchored[groups.root(i)] = true;
        }
        let mut gauge = Self { held: held.to_vec(), anchors: Vec::new(), unlinked: Vec::new() };
        for (i, linked) in linked.into_iter().enumerate() {
            let root = groups.root(i);
            if !linked {
                gauge.held[i] = true;
                gauge.unlinked.push(i);
            } else if !anchored[root] {
                anchored[root] = true;
                gauge.held[i] = true;
                gauge.anchors.push(i);
            }
        }
        gauge
    }
}

/// Disjoint sets, each named by its lowest member.
struct Groups(Vec<usize>);

impl Groups {
    fn root(&mut self, mut i: usize) -> usize {
        while self.0[i] != i {
            self.0[i] = self.0[self.0[i]];
            i = self.0[i];
        }
        i
    }

    fn join(&mut self, i: usize, j: usize) {
        let (i, j) = (self.root(i), self.root(j));
        self.0[i.max(j)] = i.min(j);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_group_without_a_held_pose_is_anchored_at_its_lowest() {
        let held = [false, false, false, false, false, true, false];
        let gauge = Gauge::new(&held, [(3, 1), (0, 2), (4, 5)].into_iter(), std::iter::empty());
        assert_eq!(gauge.anchors, [0, 1]);
        assert_eq!(gauge.unlinked, [6]);
        assert_eq!(gauge.held, [true, true, false, false, false, true, true]);
    }

    #[test]
    fn a_pose_tied_to_something_fixed_moves_and_anchors_its_group() {
        let gauge = Gauge::new(&[false; 3], [(0, 1)].into_iter(), [1, 2].into_iter());
        assert_eq!(gauge.held, [false; 3]);
        assert_eq!((gauge.anchors, gauge.unlinked), (vec![], vec![]));
    }
}
