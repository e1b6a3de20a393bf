//! Floor plans: rooms in rows, and the walls between them, into which doors and windows are cut. Used by the building, which makes solids
//! of them. The plane of a plan is the world's xy plane, in metres.

use super::draw::Draw;
use super::openings::{Doorway, Opening, cut_doors, cut_windows};
use crate::control::Seed;

/// How rooms are arranged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Layout {
    /// Rows of work rooms within a nearly rectangular outline.
    Office,
    /// Rows of living rooms of different lengths.
    House,
    /// Rooms of different sizes on both sides of a corridor, from which alone most of them are entered.
    Corridor,
    /// As [`Layout::Corridor`], but the rooms are exact copies of one another, furniture included.
    TwinRooms,
    /// One large hall that is nearly the same after half a turn.
    Hall,
    /// One large hall with rows of pallet racks, every bay of which is like the next one but for what is stored in it.
    Warehouse,
}

/// What a room is used for, and so what stands in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum RoomKind {
    /// Desks and shelves.
    Office,
    /// A long table with chairs.
    Meeting,
    /// Sofas and low tables.
    Living,
    /// A counter with cupboards, and a table.
    Kitchen,
    /// A bed and a wardrobe.
    Bedroom,
    /// Racks and cartons.
    Storage,
    /// Narrow, with little in it.
    Passage,
    /// Large, with pillars.
    Hall,
    /// Rows of pallet racks.
    Warehouse,
}

/// The inside of a room.
#[derive(Debug, Clone, PartialEq)]
pub struct Room {
    /// Corner with the smallest coordinates.
    pub low: [f32; 2],
    /// Corner with the largest coordinates.
    pub high: [f32; 2],
    /// From floor to ceiling.
    pub height: f32,
    /// What it is used for.
    pub kind: RoomKind,
    /// Rooms with the same number are furnished alike.
    pub identity: u64,
    /// Whether the room's own axes are the world's after half a turn (its door side is its own -y side).
    pub turned: bool,
}

impl Room {
    /// The middle of the floor.
    #[must_use]
    pub fn centre(&self) -> [f32; 2] {
        [0, 1].map(|k| (self.low[k] + self.high[k]) * 0.5)
    }

    /// Edge lengths.
    #[must_use]
    pub fn size(&self) -> [f32; 2] {
        [0, 1].map(|k| self.high[k] - self.low[k])
    }
}

/// A straight wall along x (`axis` 0) or y (`axis` 1), between `from` and `to`, around the line `at`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Wall {
    pub axis: usize,
    pub at: f32,
    pub from: f32,
    pub to: f32,
    pub thickness: f32,
    pub openings: Vec<Opening>,
    /// Of glass between posts instead of stone.
    pub glazed: bool,
}

/// Rooms, walls and doors of one storey.
#[derive(Debug, Clone)]
pub(super) struct Plan {
    pub rooms: Vec<Room>,
    pub walls: Vec<Wall>,
    pub doorways: Vec<Doorway>,
    /// Top of the walls.
    pub height: f32,
}

struct Row {
    start: f32,
    depth: f32,
    widths: Vec<f32>,
    passage: bool,
}

const OUTER_WALL: f32 = 0.35;

/// Draws a plan with about `rooms` rooms (corridors not counted) whose edges lie in `size`.
pub(super) fn draw_plan(layout: Layout, rooms: usize, size: [f32; 2], seed: Seed) -> Plan {
    let mut draw = Draw::new(seed.derive("simulate.plan", 0));
    let rows = draw_rows(layout, rooms, size, &mut draw);
    let mut plan = raise(layout, &rows, &mut draw);
    cut_doors(layout, &mut plan, &mut draw);
    cut_windows(layout, &mut plan, seed);
    plan
}

fn draw_rows(layout: Layout, rooms: usize, [small, large]: [f32; 2], draw: &mut Draw) -> Vec<Row> {
    let row = |start, depth, widths| Row { start, depth, widths, passage: false };
    match layout {
        Layout::Hall | Layout::Warehouse => {
            vec![row(0.0, draw.between(1.8, 2.2) * large, vec![draw.between(2.4, 3.0) * large])]
        }
        Layout::Corridor | Layout::TwinRooms => {
            let twin = [draw.between(small, large), draw.between(small, large)];
            let mut side = |count: usize| {
                let mut edge =
                    |twin: f32| if layout == Layout::TwinRooms { twin } else { draw.between(small, large) };
                let depth = edge(twin[1]);
                row(0.0, depth, (0..count).map(|_| edge(twin[0])).collect())
            };
            let (below, above) = (side(rooms / 2), side(rooms - rooms / 2));
            let length =
                [&below, &above].map(|row| row.widths.iter().sum::<f32>() + 0.15 * row.widths.len() as f32);
            let corridor = vec![length[0].max(length[1])];
            let corridor = Row { passage: true, ..row(0.0, draw.between(1.9, 2.6), corridor) };
            [below, corridor, above].into_iter().filter(|row| !row.widths.is_empty()).collect()
        }
        Layout::Office | Layout::House => {
            let count = ((rooms as f32).sqrt().round() as usize).max(1);
            let mut rows: Vec<Row> = (0..count)
                .map(|i| {
                    let in_row = rooms / count + usize::from(i < rooms % count);
                    let start = if layout == Layout::House { draw.between(0.0, 1.5) } else { 0.0 };
                    row(
                        start,
                        draw.between(small, large),
                        (0..in_row).map(|_| draw.between(small, large)).collect(),
                    )
                })
                .collect();
            if layout == Layout::Office {
                let length = |row: &Row| row.widths.iter().sum::<f32>();
                let longest = rows.iter().map(length).fold(0.0, f32::max);
                for row in &mut rows {
                    let stretch = (longest / length(row)).min(1.3);
                    row.widths.iter_mut().for_each(|width| *width *= stretch);
                }
            }
            rows
        }
    }
}

/// Lays the rows above each other and puts walls around all rooms.
fn raise(layout: Layout, rows: &[Row], draw: &mut Draw) -> Plan {
    let ceiling = match layout {
        Layout::Hall => draw.between(4.2, 5.0),
        Layout::Warehouse => draw.between(6.0, 7.5),
        _ => draw.between(2.7, 3.1),
    };
    let mut plan = Plan { rooms: Vec::new(), walls: Vec::new(), doorways: Vec::new(), height: ceiling };
    let mut y = 0.0;
    // For each line between rows: middle, thickness, and the stretch that the rows on both sides need.
    let mut lines = vec![(-OUTER_WALL * 0.5, OUTER_WALL, f32::INFINITY, f32::NEG_INFINITY)];
    for (r, row) in rows.iter().enumerate() {
        let mut x = row.start;
        plan.walls.push(upright(x - OUTER_WALL * 0.5, y, row.depth, OUTER_WALL));
        for (i, width) in row.widths.iter().enumerate() {
            let twin = layout == Layout::TwinRooms && !row.passage;
            plan.rooms.push(Room {
                low: [x, y],
                high: [x + width, y + row.depth],
                height: if twin || matches!(layout, Layout::Hall | Layout::Warehouse) {
                    ceiling
                } else {
                    ceiling - draw.between(0.0, 0.25)
                },
                kind: room_kind(layout, row.passage, plan.rooms.len()),
                identity: if twin { u64::MAX } else { plan.rooms.len() as u64 },
                turned: r == 0 && rows.get(1).is_some_and(|next| next.passage),
            });
            let gap = if i + 1 == row.widths.len() { OUTER_WALL } else { draw.between(0.1, 0.22) };
            plan.walls.push(upright(x + width + gap * 0.5, y, row.depth, gap));
            x += width + gap;
        }
        y += row.depth;
        let inner = if layout == Layout::TwinRooms { 0.2 } else { draw.between(0.12, 0.28) };
        let thickness = if r + 1 == rows.len() { OUTER_WALL } else { inner };
        lines.push((y + thickness * 0.5, thickness, f32::INFINITY, f32::NEG_INFINITY));
        for line in &mut lines[r..] {
            *line = (line.0, line.1, line.2.min(row.start - OUTER_WALL), line.3.max(x));
        }
        y += thickness;
    }
    plan.walls.extend(lines.into_iter().map(|(at, thickness, from, to)| Wall {
        axis: 0,
        at,
        from,
        to,
        thickness,
        openings: Vec::new(),
        glazed: false,
    }));
    plan
}

fn upright(at: f32, y: f32, depth: f32, thickness: f32) -> Wall {
    Wall { axis: 1, at, from: y, to: y + depth, thickness, openings: Vec::new(), glazed: false }
}

fn room_kind(layout: Layout, passage: bool, index: usize) -> RoomKind {
    use RoomKind::{Bedroom, Hall, Kitchen, Living, Meeting, Office, Passage, Storage, Warehouse};
    if passage {
        return Passage;
    }
    let kinds = match layout {
        Layout::Hall => return Hall,
        Layout::Warehouse => return Warehouse,
        Layout::TwinRooms => return Office,
        Layout::House => [Living, Kitchen, Bedroom, Office, Bedroom, Storage],
        Layout::Office | Layout::Corridor => [Office, Meeting, Office, Kitchen, Living, Storage],
    };
    kinds[index % kinds.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAYOUTS: [Layout; 6] =
        [Layout::Office, Layout::House, Layout::Corridor, Layout::TwinRooms, Layout::Hall, Layout::Warehouse];

    #[test]
    fn every_room_can_be_reached_through_doors() {
        for layout in LAYOUTS {
            for seed in 0..20 {
                let plan = draw_plan(layout, 1 + seed as usize % 8, [4.0, 7.0], Seed(seed));
                let mut reached = vec![false; plan.rooms.len()];
                reached[0] = true;
                for _ in 0..plan.rooms.len() {
                    for doorway in &plan.doorways {
                        let [a, b] = doorway.rooms;
                        let either = reached[a] || reached[b];
                        (reached[a], reached[b]) = (either, either);
                    }
                }
                assert!(reached.iter().all(|&r| r), "{layout:?}, seed {seed}: {reached:?}");
            }
        }
    }

    #[test]
    fn rooms_do_not_overlap_and_openings_of_a_wall_do_not_touch() {
        for layout in LAYOUTS {
            for seed in 0..20 {
                let plan = draw_plan(layout, 6, [4.0, 7.0], Seed(seed));
                for (i, a) in plan.rooms.iter().enumerate() {
                    for b in &plan.rooms[i + 1..] {
                        assert!((0..2).any(|k| a.high[k] < b.low[k] || b.high[k] < a.low[k]));
                    }
                }
                for wall in &plan.walls {
                    for (i, a) in wall.openings.iter().enumerate() {
                        assert!(a.from < a.to && a.sill < a.head && a.head < plan.height);
                        assert!(
                            wall.openings[i + 1..].iter().all(|b| a.to < b.from || b.to < a.from),
                            "{wall:?}"
                        );
                    }
                }
            }
        }
    }
}
