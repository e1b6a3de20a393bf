//! Shelves, cabinets and what stands in them. All of them stand with their backs to a wall.

use nalgebra::{Rotation3, Vector3};

use super::{Piece, block, clutter};
use crate::simulate::draw::Draw;

/// An open shelf with books, boxes and gaps.
pub(in crate::simulate) fn shelf(draw: &mut Draw) -> Piece {
    let (width, depth, height) = (draw.between(0.7, 1.6), draw.between(0.25, 0.4), draw.between(1.2, 2.2));
    let mut piece = Piece::new(width, depth, height);
    let board = 0.025;
    for side in [-1.0, 1.0] {
        piece.block([side * (width - board) * 0.5, 0.0, 0.0], [board, depth, height]);
    }
    if draw.chance(0.6) {
        piece.block([0.0, depth * 0.5 - 0.005, 0.0], [width, 0.01, height]);
    }
    let levels = draw.count(3, 6);
    let step = (height - 0.05) / levels as f32;
    for level in 0..=levels {
        let z = 0.02 + step * level as f32;
        piece.block([0.0, 0.0, z], [width, depth, board]);
        if level < levels {
            books(&mut piece, draw, [width * 0.5 - board, depth * 0.5], z + board, step - board);
        }
    }
    piece
}

/// Books, boxes and empty stretches along one board of a shelf.
fn books(piece: &mut Piece, draw: &mut Draw, [half_width, half_depth]: [f32; 2], z: f32, room: f32) {
    let mut x = -half_width;
    while x < half_width - 0.06 {
        let remaining = half_width - x;
        match draw.count(0, 3) {
            0 => x += draw.between(0.05, 0.35),
            1 => {
                let width = draw.between(0.12, 0.4).min(remaining);
                let depth = draw.between(0.6, 1.0) * half_depth * 2.0;
                let size = [width - 0.01, depth, draw.between(0.3, 0.85) * room];
                piece.block([x + width * 0.5, draw.between(-0.02, 0.02), z], size);
                x += width + draw.between(0.01, 0.08);
            }
            _ => {
                for _ in 0..draw.count(2, 6) {
                    let thickness = draw.between(0.025, 0.07);
                    if x + thickness > half_width {
                        break;
                    }
                    let depth = draw.between(0.55, 0.85) * half_depth * 2.0;
                    let size = [thickness, depth, draw.between(0.45, 0.9) * room];
                    piece.block([x + thickness * 0.5, half_depth - depth * 0.5 - 0.01, z], size);
                    x += thickness + 0.002;
                }
            }
        }
    }
}

/// A tall cupboard with doors, handles and things on top.
pub(in crate::simulate) fn wardrobe(draw: &mut Draw) -> Piece {
    let (width, depth, height) = (draw.between(0.9, 2.0), draw.between(0.45, 0.62), draw.between(1.8, 2.2));
    closed(draw, width, depth, height)
}

/// A low cupboard with doors, handles and things on top.
pub(in crate::simulate) fn cabinet(draw: &mut Draw) -> Piece {
    let (width, depth, height) = (draw.between(0.7, 1.6), draw.between(0.35, 0.5), draw.between(0.65, 1.2));
    closed(draw, width, depth, height)
}

fn closed(draw: &mut Draw, width: f32, depth: f32, height: f32) -> Piece {
    let mut piece = Piece::new(width, depth, height);
    let plinth = draw.between(0.04, 0.12);
    piece.block([0.0, 0.02, 0.0], [width - 0.06, depth - 0.06, plinth]);
    piece.block([0.0, 0.01, plinth], [width, depth - 0.02, height - plinth]);
    let doors = (width / 0.5).round().max(1.0);
    let leaf = width / doors;
    for i in 0..doors as usize {
        let x = (i as f32 + 0.5) * leaf - width * 0.5;
        // Doors stand out of the front a little, so that their joints show as grooves.
        piece.block([x, -depth * 0.5 + 0.01, plinth + 0.02], [leaf - 0.03, 0.02, height - plinth - 0.04]);
        let handle = x + draw.pick([-1.0, 1.0]) * (leaf * 0.5 - 0.06);
        piece.rod(
            [handle, -depth * 0.5 - 0.02, height * 0.45],
            [handle, -depth * 0.5 - 0.02, height * 0.6],
            0.01,
        );
    }
    let amount = draw.count(0, 5);
    clutter(&mut piece, draw, [width * 0.4, depth * 0.3], height, amount);
    piece
}

/// A chest of drawers, some of them pulled out.
pub(in crate::simulate) fn drawers(draw: &mut Draw) -> Piece {
    let (width, depth, height) = (draw.between(0.4, 1.0), draw.between(0.4, 0.5), draw.between(0.55, 1.3));
    let mut piece = Piece::new(width, depth, height);
    piece.block([0.0, 0.01, 0.0], [width, depth - 0.02, height]);
    let count = draw.count(2, 5);
    let step = height / count as f32;
    for i in 0..count {
        let out = if draw.chance(0.2) { draw.between(0.05, 0.2) } else { 0.015 };
        let z = step * i as f32;
        piece.block([0.0, -depth * 0.5 + 0.01 - out * 0.5, z + 0.015], [width - 0.03, out, step - 0.03]);
        piece.block([0.0, -depth * 0.5 - out, z + step * 0.5], [0.12, 0.03, 0.02]);
    }
    let amount = draw.count(0, 5);
    clutter(&mut piece, draw, [width * 0.4, depth * 0.3], height, amount);
    piece
}

/// A kitchen: counter with sink, tap and stove hood, wall cupboards above, appliances, perhaps a fridge.
pub(in crate::simulate) fn kitchen_counter(draw: &mut Draw) -> Piece {
    let (width, depth, height) = (draw.between(1.8, 3.0), 0.62, draw.between(0.86, 0.94));
    let mut piece = Piece::new(width, depth, 2.1);
    piece.block([0.0, 0.03, 0.0], [width, depth - 0.1, 0.1]);
    piece.block([0.0, 0.02, 0.1], [width, depth - 0.04, height - 0.14]);
    piece.block([0.0, 0.0, height - 0.04], [width, depth, 0.04]);
    let units = (width / 0.6) as usize;
    for i in 0..units {
        let x = (i as f32 + 0.5) / units as f32 * width - width * 0.5;
        piece.block([x, -depth * 0.5 + 0.03, 0.12], [width / units as f32 - 0.03, 0.02, height - 0.2]);
        piece.rod([x - 0.12, -depth * 0.5, height - 0.14], [x + 0.12, -depth * 0.5, height - 0.14], 0.01);
        if draw.chance(0.75) {
            let deep = draw.between(0.28, 0.38);
            let tall = draw.between(0.5, 0.75);
            piece.block([x, (depth - deep) * 0.5, 1.42], [width / units as f32 - 0.02, deep, tall]);
        }
    }
    let tap = draw.between(-0.3, 0.3) * width;
    piece.rod([tap, depth * 0.38, height], [tap, depth * 0.38, height + 0.3], 0.015);
    piece.rod([tap, depth * 0.38, height + 0.3], [tap, depth * 0.1, height + 0.26], 0.015);
    let amount = draw.count(4, 10);
    clutter(&mut piece, draw, [width * 0.45, depth * 0.3], height, amount);
    if draw.chance(0.7) {
        let side = draw.pick([-1.0, 1.0]);
        piece.block([side * (width * 0.5 - 0.3), 0.0, 0.0], [0.6, 0.66, draw.between(1.6, 1.95)]);
    }
    piece
}

/// An open metal rack with cartons at odd angles.
pub(in crate::simulate) fn rack(draw: &mut Draw) -> Piece {
    let (width, depth, height) = (draw.between(1.0, 1.8), draw.between(0.4, 0.6), draw.between(1.6, 2.2));
    let mut piece = Piece::new(width, depth, height);
    for (sx, sy) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        piece.block([sx * (width - 0.04) * 0.5, sy * (depth - 0.04) * 0.5, 0.0], [0.04, 0.04, height]);
    }
    let levels = draw.count(3, 4);
    for level in 0..levels {
        let z = 0.1 + (height - 0.15) * level as f32 / (levels - 1) as f32;
        piece.block([0.0, 0.0, z], [width, depth, 0.03]);
        let room = (height - 0.15) / (levels - 1) as f32 - 0.06;
        for _ in 0..draw.count(1, 4) {
            let size = [draw.between(0.15, 0.4), draw.between(0.2, 0.4), draw.between(0.35, 0.95) * room];
            let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), draw.between(-0.3, 0.3));
            let at = Vector3::new(draw.between(-0.38, 0.38) * width, 0.0, z + 0.03);
            piece.push(block([0.0; 3], size).moved(turn.matrix(), &at));
        }
    }
    piece
}

/// Width of one bay of a [`pallet_rack`], metres: three pallets side by side.
pub(in crate::simulate) const PALLET_RACK_BAY: f32 = 2.8;
/// Depth of a [`pallet_rack`], metres.
pub(in crate::simulate) const PALLET_RACK_DEPTH: f32 = 1.1;

/// A row of a warehouse: bays of pallets between uprights, each place taken with a probability, from both sides the same.
pub(in crate::simulate) fn pallet_rack(draw: &mut Draw, bays: usize, levels: usize, taken: f32) -> Piece {
    let (width, level_height) = (bays as f32 * PALLET_RACK_BAY, 1.45);
    let depth = PALLET_RACK_DEPTH;
    let mut piece = Piece::new(width + 0.1, depth, level_height * (levels as f32 - 0.2));
    for upright in 0..=bays {
        let x = upright as f32 * PALLET_RACK_BAY - width * 0.5;
        for side in [-1.0, 1.0] {
            piece.block([x, side * (depth * 0.5 - 0.05), 0.0], [0.1, 0.1, piece.height]);
        }
    }
    for level in 0..levels {
        let z = level_height * level as f32;
        if level > 0 {
            for side in [-1.0, 1.0] {
                piece.block([0.0, side * (depth * 0.5 - 0.05), z - 0.12], [width, 0.05, 0.12]);
            }
        }
        for slot in 0..3 * bays {
            if draw.chance(taken) {
                let x = (slot as f32 + 0.5) * PALLET_RACK_BAY / 3.0 - width * 0.5;
                let pallet = pallet(draw);
                piece.add(&pallet, [x + draw.between(-0.03, 0.03), draw.between(-0.08, 0.08), z], 0.0);
            }
        }
    }
    piece
}

/// A pallet with goods in one block, or in cartons of several heights.
pub(in crate::simulate) fn pallet(draw: &mut Draw) -> Piece {
    let (width, depth, board) = (0.8, 1.0, 0.14);
    let mut piece = Piece::new(width, depth, 1.2);
    piece.block([0.0, 0.0, board - 0.03], [width, depth, 0.03]);
    for x in [-0.35, 0.0, 0.35] {
        piece.block([x, 0.0, 0.0], [0.1, depth, board - 0.03]);
    }
    if draw.chance(0.5) {
        let size = [draw.between(0.6, 0.8), draw.between(0.7, 1.0), draw.between(0.3, 1.0)];
        piece.block([0.0, draw.between(-0.05, 0.05), board], size);
    } else {
        for (x, y) in [(-0.2, -0.25), (0.2, -0.25), (-0.2, 0.25), (0.2, 0.25)] {
            let size = [draw.between(0.3, 0.4), draw.between(0.35, 0.48), draw.between(0.1, 0.95)];
            piece.block([x, y, board], size);
        }
    }
    piece
}
