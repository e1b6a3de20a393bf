//! Many solids, and the first of them that a ray meets: a bounding volume hierarchy built by the surface area
//! heuristic. Uses [`Solid`]; used by the stations, which look around, and by the sensors.

use nalgebra::Vector3;

use super::solid::{Hit, Ray, Solid};

/// Solids sorted for ray casting. Immutable.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    solids: Vec<Solid>,
    nodes: Vec<Node>,
}

#[derive(Debug, Clone, Copy)]
struct Node {
    low: Vector3<f32>,
    high: Vector3<f32>,
    /// A leaf: index of the first of `count` solids. An inner node: index of the right child; the left one follows.
    index: u32,
    /// Zero for an inner node.
    count: u32,
}

/// Largest number of solids in a leaf.
const LEAF_SIZE: usize = 3;
/// From this depth on, nodes are halved whatever their shapes, so that the depth stays below `STACK_SIZE`.
const HALVE_FROM_DEPTH: usize = 32;
/// Nodes that may wait during a traversal: `HALVE_FROM_DEPTH` and the 32 halvings of a `u32` count.
const STACK_SIZE: usize = 64;

impl Scene {
    /// Sorts the solids. n log^2 n.
    #[must_use]
    pub fn new(solids: &[Solid]) -> Self {
        let mut items: Vec<Item> = solids.iter().enumerate().map(Item::new).collect();
        let mut nodes = Vec::with_capacity(2 * items.len());
        if !items.is_empty() {
            build(&mut items, 0, 0, &mut nodes);
        }
        let solids = items.iter().map(|item| solids[item.solid].clone()).collect();
        Self { solids, nodes }
    }

    /// All solids, in the order of the hierarchy.
    #[must_use]
    pub fn solids(&self) -> &[Solid] {
        &self.solids
    }

    /// The corners of the box that holds everything; both zero when there is nothing.
    #[must_use]
    pub fn bounds(&self) -> (Vector3<f32>, Vector3<f32>) {
        self.nodes.first().map_or_else(|| (Vector3::zeros(), Vector3::zeros()), |root| (root.low, root.high))
    }

    /// The first surface that a ray meets at a distance in `(near, far)`.
    #[must_use]
    pub fn cast(&self, ray: &Ray, near: f32, far: f32) -> Option<Hit> {
        let inverse = ray.direction.map(f32::recip);
        let mut best: Option<Hit> = None;
        let mut stack = [(0u32, 0.0f32); STACK_SIZE];
        let mut waiting = 0;
        if let Some(entry) = self.nodes.first().and_then(|root| root.enter(ray, &inverse, far)) {
            stack[0] = (0, entry);
            waiting = 1;
        }
        while waiting > 0 {
            waiting -= 1;
            let (at, entry) = stack[waiting];
            let limit = best.map_or(far, |hit| hit.distance);
            if entry >= limit {
                continue;
            }
            let node = &self.nodes[at as usize];
            if node.count > 0 {
                for solid in &self.solids[node.index as usize..(node.index + node.count) as usize] {
                    let limit = best.map_or(far, |hit| hit.distance);
                    best = solid.meet(ray, near, limit).or(best);
                }
                continue;
            }
            let (left, right) = (at + 1, node.index);
            let left_entry = self.nodes[left as usize].enter(ray, &inverse, limit);
            let right_entry = self.nodes[right as usize].enter(ray, &inverse, limit);
            // The nearer child goes on top, so that the farther one can often be skipped.
            let children = match (left_entry, right_entry) {
                (Some(l), Some(r)) if l <= r => [Some((right, r)), Some((left, l))],
                (l, r) => [l.map(|l| (left, l)), r.map(|r| (right, r))],
            };
            for child in children.into_iter().flatten() {
                stack[waiting] = child;
                waiting += 1;
            }
        }
        best
    }
}

impl Node {
    /// The distance at which a ray enters the box, zero from inside, if it does so before `far`.
    fn enter(&self, ray: &Ray, inverse: &Vector3<f32>, far: f32) -> Option<f32> {
        let (mut enter, mut leave) = (0.0f32, far);
        for axis in 0..3 {
            let a = (self.low[axis] - ray.origin[axis]) * inverse[axis];
            let b = (self.high[axis] - ray.origin[axis]) * inverse[axis];
            // `max` and `min` pass over the NaN of a ray that lies in a plane of the box.
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        (enter <= leave).then_some(enter)
    }
}

/// A solid on its way into the hierarchy.
#[derive(Clone, Copy)]
struct Item {
    low: Vector3<f32>,
    high: Vector3<f32>,
    solid: usize,
}

impl Item {
    fn new((solid, shape): (usize, &Solid)) -> Self {
        let (low, high) = shape.bounds();
        // Rounding must not let a ray slip past a flat box.
        Self { low: low.add_scalar(-1e-4), high: high.add_scalar(1e-4), solid }
    }

    fn middle(&self, axis: usize) -> f32 {
        self.low[axis] + self.high[axis]
    }
}

fn bounds_of(items: &[Item]) -> (Vector3<f32>, Vector3<f32>) {
    items
        .iter()
        .fold((Vector3::repeat(f32::INFINITY), Vector3::repeat(f32::NEG_INFINITY)), |(low, high), item| {
            (low.inf(&item.low), high.sup(&item.high))
        })
}

fn half_area(low: &Vector3<f32>, high: &Vector3<f32>) -> f32 {
    let size = high - low;
    size.x * size.y + size.y * size.z + size.z * size.x
}

/// Appends the node of `items` (of which the first is number `first`) and all below it.
fn build(items: &mut [Item], first: usize, depth: usize, nodes: &mut Vec<Node>) {
    let (low, high) = bounds_of(items);
    let at = nodes.len();
    nodes.push(Node { low, high, index: first as u32, count: items.len() as u32 });
    if items.len() <= LEAF_SIZE {
        return;
    }
    let split = if depth < HALVE_FROM_DEPTH { sort_and_split(items) } else { items.len() / 2 };
    let (left, right) = items.split_at_mut(split);
    build(left, first, depth + 1, nodes);
    nodes[at].index = nodes.len() as u32;
    nodes[at].count = 0;
    build(right, first + split, depth + 1, nodes);
}

/// Sorts along the axis, and returns the place of the cut, with the least expected cost: the sum over both sides of
/// surface times number of solids.
fn sort_and_split(items: &mut [Item]) -> usize {
    let mut best = (f32::INFINITY, 0, items.len() / 2);
    let mut right_areas = vec![0.0; items.len()];
    for axis in 0..3 {
        sort_along(items, axis);
        let mut right = bounds_of(&[]);
        for (i, item) in items.iter().enumerate().rev() {
            right = (right.0.inf(&item.low), right.1.sup(&item.high));
            right_areas[i] = half_area(&right.0, &right.1);
        }
        let mut left = bounds_of(&[]);
        for cut in 1..items.len() {
            left = (left.0.inf(&items[cut - 1].low), left.1.sup(&items[cut - 1].high));
            let cost =
                half_area(&left.0, &left.1) * cut as f32 + right_areas[cut] * (items.len() - cut) as f32;
            if cost < best.0 {
                best = (cost, axis, cut);
            }
        }
    }
    let (_, axis, cut) = best;
    if axis != 2 {
        sort_along(items, axis);
    }
    cut
}

fn sort_along(items: &mut [Item], axis: usize) {
    // The index makes the order, and so the scene, unique.
    items.sort_unstable_by(|a, b| a.middle(axis).total_cmp(&b.middle(axis)).then(a.solid.cmp(&b.solid)));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Seed;
    use crate::simulate::draw::Draw;
    use crate::simulate::solid::Shape;
    use nalgebra::Rotation3;

    fn random_vector(draw: &mut Draw, reach: f32) -> Vector3<f32> {
        Vector3::from_fn(|_, _| draw.between(-reach, reach))
    }

    fn random_solid(draw: &mut Draw) -> Solid {
        let size = draw.between(0.05, 0.6);
        let shape = match draw.count(0, 3) {
            0 => Shape::Cuboid(Vector3::new(size, 0.3, 0.1)),
            1 => Shape::Cylinder { radius: size, half_height: 0.4 },
            2 => Shape::Ball { radius: size },
            _ => Shape::Triangle([0, 1, 2].map(|_| random_vector(draw, 1.0))),
        };
        let turn = Rotation3::from_euler_angles(draw.angle(), draw.angle(), draw.angle());
        Solid::new(shape, Vector3::zeros()).moved(turn.matrix(), &random_vector(draw, 5.0))
    }

    #[test]
    fn the_hierarchy_finds_the_same_hit_as_trying_every_solid() {
        let mut draw = Draw::new(Seed(11).derive("test", 0));
        let solids: Vec<Solid> = (0..300).map(|_| random_solid(&mut draw)).collect();
        let scene = Scene::new(&solids);
        let mut hits = 0;
        for _ in 0..2000 {
            let ray = Ray {
                origin: random_vector(&mut draw, 6.0),
                direction: random_vector(&mut draw, 1.0).normalize(),
            };
            let expected = solids
                .iter()
                .filter_map(|solid| solid.meet(&ray, 0.0, 20.0))
                .min_by(|a, b| a.distance.total_cmp(&b.distance));
            let found = scene.cast(&ray, 0.0, 20.0);
            assert_eq!(found.map(|hit| hit.distance), expected.map(|hit| hit.distance));
            hits += usize::from(found.is_some());
        }
        assert!(hits > 300, "only {hits} rays met anything");
    }

    #[test]
    fn an_empty_scene_is_never_met() {
        let ray = Ray { origin: Vector3::zeros(), direction: Vector3::x() };
        assert_eq!(Scene::default().cast(&ray, 0.0, 9.0), None);
        assert_eq!(Scene::new(&[]).bounds(), (Vector3::zeros(), Vector3::zeros()));
    }
}
