//! The gaps in the walls of a floor plan: doors and passages that link all rooms, and windows to the outside. Used by the plan, which has
//! them cut into its walls, and by all who build or furnish what is around them.

use super::draw::Draw;
use super::plan::{Layout, Plan, Room, RoomKind};
use crate::control::Seed;

/// Shortest stretch of wall that two rooms must share to get a door.
const SHARED_FOR_DOOR: f32 = 1.8;

/// A gap in a wall, from `from` to `to` along it and from `sill` to `head` above the floor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Opening {
    pub from: f32,
    pub to: f32,
    pub sill: f32,
    pub head: f32,
    pub kind: OpeningKind,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum OpeningKind {
    /// An open passage.
    Passage,
    /// A door that stands open by an angle (rad), hinged at `from`.
    Door(f32),
    /// The same, of glass in a frame.
    GlassDoor(f32),
    /// A window without a pane.
    Hole,
    /// A window with a pane.
    Pane,
}

/// Where one walks from one room into another.
#[derive(Debug, Clone, PartialEq)]
pub struct Doorway {
    /// Indices of the two rooms.
    pub rooms: [usize; 2],
    /// Middle of the passage.
    pub centre: [f32; 2],
    /// Direction of the wall: 0 along x, 1 along y.
    pub axis: usize,
    /// Clear width.
    pub width: f32,
}

/// Cuts doors so that every room can be reached from every other one, and some more.
pub(super) fn cut_doors(layout: Layout, plan: &mut Plan, draw: &mut Draw) {
    let mut pairs: Vec<Shared> = (0..plan.rooms.len())
        .flat_map(|a| (a + 1..plan.rooms.len()).map(move |b| (a, b)))
        .filter_map(|(a, b)| Shared::of(plan, a, b))
        .filter(|pair| layout != Layout::TwinRooms || pair.touches_passage(plan))
        .collect();
    draw.shuffle(&mut pairs);
    // Doors to the corridor come first, so that they make the tree.
    pairs.sort_by_key(|pair| !pair.touches_passage(plan));
    let mut group: Vec<usize> = (0..plan.rooms.len()).collect();
    for pair in pairs {
        let [a, b] = pair.rooms;
        let joins = group[a] != group[b];
        if !joins && !draw.chance(0.3) {
            continue;
        }
        let (old, new) = (group[b], group[a]);
        group.iter_mut().filter(|g| **g == old).for_each(|g| *g = new);
        cut_door(layout, plan, &pair, draw);
    }
}

/// The stretch of wall between two rooms.
struct Shared {
    rooms: [usize; 2],
    wall: usize,
    from: f32,
    to: f32,
}

impl Shared {
    fn of(plan: &Plan, a: usize, b: usize) -> Option<Self> {
        let (room_a, room_b) = (&plan.rooms[a], &plan.rooms[b]);
        plan.walls.iter().enumerate().find_map(|(index, wall)| {
            let (along, across) = (wall.axis, 1 - wall.axis);
            let touches = |high: f32, low: f32| {
                (high - (wall.at - wall.thickness * 0.5)).abs() < 1e-3
                    && (low - (wall.at + wall.thickness * 0.5)).abs() < 1e-3
            };
            let between = touches(room_a.high[across], room_b.low[across])
                || touches(room_b.high[across], room_a.low[across]);
            let from = room_a.low[along].max(room_b.low[along]).max(wall.from);
            let to = room_a.high[along].min(room_b.high[along]).min(wall.to);
            (between && to - from > SHARED_FOR_DOOR).then_some(Self { rooms: [a, b], wall: index, from, to })
        })
    }

    fn touches_passage(&self, plan: &Plan) -> bool {
        self.rooms.iter().any(|&room| plan.rooms[room].kind == RoomKind::Passage)
    }
}

fn cut_door(layout: Layout, plan: &mut Plan, shared: &Shared, draw: &mut Draw) {
    let (mut width, mut head, mut kind) = (draw.between(0.85, 1.05), 2.05, OpeningKind::Passage);
    match draw.count(0, 3) {
        0 | 1 => kind = OpeningKind::Door(draw.between(1.5, 1.95)),
        2 => (width, head) = (draw.between(1.1, 1.2), draw.between(2.1, 2.3)),
        _ => {}
    }
    let mut middle = draw.between(shared.from + 0.85, shared.to - 0.85);
    if layout == Layout::TwinRooms {
        // The same place in each copy: the middle of its own front.
        (width, head, kind) = (0.95, 2.05, OpeningKind::Passage);
        middle = (shared.from + shared.to) * 0.5;
    }
    let wall = &mut plan.walls[shared.wall];
    wall.openings.push(Opening {
        from: middle - width * 0.5,
        to: middle + width * 0.5,
        sill: 0.0,
        head,
        kind,
    });
    let centre = if wall.axis == 0 { [middle, wall.at] } else { [wall.at, middle] };
    plan.doorways.push(Doorway { rooms: shared.rooms, centre, axis: wall.axis, width });
}

/// Cuts windows into outer walls. Copies of a room get the same ones.
pub(super) fn cut_windows(layout: Layout, plan: &mut Plan, seed: Seed) {
    for r in 0..plan.rooms.len() {
        let room = plan.rooms[r].clone();
        for own_side in 0..4 {
            // Only their back is an outer wall of every copy.
            if layout == Layout::TwinRooms && room.kind != RoomKind::Passage && own_side != 2 {
                continue;
            }
            let side = if room.turned { (own_side + 2) % 4 } else { own_side };
            let purpose = (u128::from(room.identity) << 8) | own_side as u128;
            let mut draw = Draw::new(seed.derive("simulate.windows", purpose));
            let axis = side % 2;
            let length = room.size()[axis];
            let most = if room.kind == RoomKind::Passage { 1 } else { ((length / 2.2) as usize).min(5) };
            for i in 0..most {
                let slot = length / most as f32;
                let width = draw.between(0.7, (slot - 0.5).min(2.4));
                let own =
                    (i as f32 + 0.5) * slot - length * 0.5 + draw.between(-0.5, 0.5) * (slot - width - 0.4);
                let middle = room.centre()[axis] + if room.turned { -own } else { own };
                let kind = if draw.chance(0.75) { OpeningKind::Pane } else { OpeningKind::Hole };
                let (sill, head) = (draw.between(0.75, 1.05), draw.between(1.9, room.height - 0.25));
                let (from, to) = (middle - width * 0.5, middle + width * 0.5);
                if draw.chance(0.55) && width > 0.6 {
                    let opening = Opening { from, to, sill, head, kind };
                    cut_window(plan, &room, side, opening);
                }
            }
        }
    }
}

/// Cuts a window if nothing but the outside is behind it.
fn cut_window(plan: &mut Plan, room: &Room, side: usize, opening: Opening) {
    let (along, across) = (side % 2, 1 - side % 2);
    let outwards = if side == 1 || side == 2 { room.high[across] } else { room.low[across] };
    let beyond = outwards + if side == 1 || side == 2 { 0.6 } else { -0.6 };
    let inside_another = plan.rooms.iter().any(|other| {
        other.low[across] < beyond
            && other.high[across] > beyond
            && other.low[along] - 0.5 < opening.to
            && other.high[along] + 0.5 > opening.from
    });
    if inside_another {
        return;
    }
    let wall = plan.walls.iter_mut().find(|wall| {
        wall.axis == along
            && ((wall.at - outwards).abs() - wall.thickness * 0.5).abs() < 1e-3
            && wall.from < opening.from
            && wall.to > opening.to
    });
    if let Some(wall) = wall {
        wall.openings.push(opening);
    }
}
