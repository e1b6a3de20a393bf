//! Tables and what lies on them.

use super::seats::{chair, office_chair};
use super::{Piece, clutter, screen};
use crate::simulate::draw::Draw;

/// A top on legs; returns the piece and the height of its top.
fn plain_table(draw: &mut Draw, width: f32, depth: f32, height: f32) -> Piece {
    let thickness = draw.between(0.02, 0.05);
    let mut piece = Piece::new(width, depth, height);
    piece.legs(draw, height - thickness);
    piece.block([0.0, 0.0, height - thickness], [width, depth, thickness]);
    if draw.chance(0.4) {
        let rail = draw.between(0.06, 0.12);
        for side in [-1.0, 1.0] {
            piece.block(
                [0.0, side * (depth * 0.5 - 0.08), height - thickness - rail],
                [width - 0.2, 0.02, rail],
            );
        }
    }
    piece
}

/// A desk with screens, a keyboard, clutter, drawers below and a chair. Its back goes to a wall.
pub(in crate::simulate) fn desk(draw: &mut Draw) -> Piece {
    let (width, depth, height) = (draw.between(1.2, 1.9), draw.between(0.65, 0.9), draw.between(0.7, 0.78));
    let mut top = plain_table(draw, width, depth, height);
    for _ in 0..draw.count(1, 2) {
        let screen_width = draw.between(0.45, 0.75);
        let at = [draw.between(-0.3, 0.3) * width, depth * 0.25, height];
        let angle = draw.between(-0.4, 0.4);
        top.add(&screen(draw, screen_width), at, angle);
    }
    top.block([draw.between(-0.2, 0.2), -depth * 0.2, height], [0.44, 0.15, 0.02]);
    let amount = draw.count(2, 7);
    clutter(&mut top, draw, [width * 0.42, depth * 0.35], height, amount);
    if draw.chance(0.7) {
        let side = draw.pick([-1.0, 1.0]);
        top.block([side * (width * 0.5 - 0.3), 0.05, 0.03], [0.4, depth - 0.2, draw.between(0.45, 0.6)]);
    }
    if draw.chance(0.6) {
        top.block([draw.between(-0.3, 0.3) * width, 0.15, 0.0], [0.2, 0.42, 0.42]);
    }
    // The chair stands in front of the desk, inside the common footprint.
    let room_for_chair = 0.55;
    let mut piece = Piece::new(width, depth + room_for_chair, height + 0.4);
    piece.add(&top, [0.0, room_for_chair * 0.5, 0.0], 0.0);
    let seat = if draw.chance(0.7) { office_chair(draw) } else { chair(draw) };
    let at = [draw.between(-0.25, 0.25), -depth * 0.5, 0.0];
    let angle = std::f32::consts::PI + draw.between(-0.9, 0.9);
    piece.add(&seat, at, angle);
    piece
}

/// A round or rectangular table with two to six chairs around it.
pub(in crate::simulate) fn dining_table(draw: &mut Draw) -> Piece {
    let height = draw.between(0.72, 0.78);
    let (mut top, half) = if draw.chance(0.4) {
        let radius = draw.between(0.4, 0.65);
        let mut top = Piece::new(2.0 * radius, 2.0 * radius, height);
        top.rod([0.0; 3], [0.0, 0.0, 0.03], radius * 0.55);
        top.rod([0.0; 3], [0.0, 0.0, height], 0.05);
        top.rod([0.0, 0.0, height - 0.03], [0.0, 0.0, height], radius);
        (top, [radius; 2])
    } else {
        let (width, depth) = (draw.between(1.1, 1.8), draw.between(0.75, 0.95));
        (plain_table(draw, width, depth, height), [width * 0.5, depth * 0.5])
    };
    let amount = draw.count(2, 6);
    clutter(&mut top, draw, [half[0] * 0.6, half[1] * 0.6], height, amount);
    let mut piece = Piece::new(2.0 * half[0] + 0.7, 2.0 * half[1] + 0.7, height + 0.3);
    piece.add(&top, [0.0; 3], 0.0);
    for (x, y, angle) in [
        (0.0, half[1], 0.0),
        (0.0, -half[1], std::f32::consts::PI),
        (half[0], 0.0, -std::f32::consts::FRAC_PI_2),
        (-half[0], 0.0, std::f32::consts::FRAC_PI_2),
    ] {
        if draw.chance(0.8) {
            let slide = draw.between(-0.15, 0.15);
            let pull = draw.between(0.95, 1.25);
            let at = [
                x * pull + if y == 0.0 { 0.0 } else { slide },
                y * pull + if y == 0.0 { slide } else { 0.0 },
                0.0,
            ];
            let turn = angle + draw.between(-0.35, 0.35);
            piece.add(&chair(draw), at, turn);
        }
    }
    piece
}

/// A long table with a row of chairs on both sides, as in meeting rooms and halls.
pub(in crate::simulate) fn long_table(draw: &mut Draw) -> Piece {
    let (width, depth, height) = (draw.between(2.0, 3.2), draw.between(0.9, 1.2), draw.between(0.72, 0.76));
    let mut top = plain_table(draw, width, depth, height);
    let amount = draw.count(3, 10);
    clutter(&mut top, draw, [width * 0.45, depth * 0.35], height, amount);
    let mut piece = Piece::new(width + 0.1, depth + 0.8, height + 0.3);
    piece.add(&top, [0.0; 3], 0.0);
    let seats = (width / 0.75) as usize;
    for side in [-1.0, 1.0] {
        for i in 0..seats {
            if draw.chance(0.85) {
                let x = (i as f32 + 0.5) / seats as f32 * width - width * 0.5 + draw.between(-0.08, 0.08);
                let y = side * (depth * 0.5 + draw.between(-0.05, 0.15));
                let angle = if side > 0.0 { 0.0 } else { std::f32::consts::PI } + draw.between(-0.3, 0.3);
                piece.add(&chair(draw), [x, y, 0.0], angle);
            }
        }
    }
    piece
}

/// A low table with a few things on it.
pub(in crate::simulate) fn coffee_table(draw: &mut Draw) -> Piece {
    let (width, depth, height) = (draw.between(0.6, 1.2), draw.between(0.45, 0.7), draw.between(0.35, 0.5));
    let mut piece = plain_table(draw, width, depth, height);
    if draw.chance(0.5) {
        piece.block([0.0, 0.0, height * 0.35], [width * 0.9, depth * 0.9, 0.02]);
    }
    let amount = draw.count(1, 5);
    clutter(&mut piece, draw, [width * 0.35, depth * 0.35], height, amount);
    piece
}
