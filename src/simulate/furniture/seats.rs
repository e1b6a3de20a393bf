//! What people sit and lie on.

use nalgebra::{Rotation3, Vector3};

use super::{Piece, block};
use crate::simulate::draw::Draw;

/// A chair with four legs and a back, solid or of slats.
pub(in crate::simulate) fn chair(draw: &mut Draw) -> Piece {
    let (width, depth) = (draw.between(0.38, 0.48), draw.between(0.38, 0.46));
    let (seat, top) = (draw.between(0.42, 0.48), draw.between(0.75, 1.0));
    let mut piece = Piece::new(width, depth, top);
    piece.legs(draw, seat - 0.03);
    piece.block([0.0, 0.0, seat - 0.03], [width, depth, 0.04]);
    let back = depth * 0.5 - 0.02;
    if draw.chance(0.5) {
        piece.block([0.0, back, seat + 0.12], [width * 0.95, 0.03, top - seat - 0.12]);
    } else {
        for i in 0..3 {
            let z = seat + (top - seat) * (0.3 + 0.25 * i as f32);
            piece.block([0.0, back, z], [width * 0.9, 0.02, 0.06]);
        }
    }
    for side in [-1.0, 1.0] {
        piece.block([side * (width * 0.5 - 0.02), back, seat], [0.03, 0.03, top - seat]);
    }
    piece
}

/// A swivel chair on a five-armed foot, some with arm rests.
pub(in crate::simulate) fn office_chair(draw: &mut Draw) -> Piece {
    let (seat, width) = (draw.between(0.44, 0.54), draw.between(0.44, 0.52));
    let mut piece = Piece::new(0.6, 0.6, seat + 0.55);
    for i in 0..5 {
        let (sin, cos) = (std::f32::consts::TAU * i as f32 / 5.0).sin_cos();
        piece.rod([0.0, 0.0, 0.1], [0.28 * cos, 0.28 * sin, 0.07], 0.02);
        piece.ball([0.28 * cos, 0.28 * sin, 0.03], 0.03);
    }
    piece.rod([0.0, 0.0, 0.08], [0.0, 0.0, seat - 0.05], 0.03);
    piece.block([0.0, 0.0, seat - 0.05], [width, 0.46, 0.08]);
    let lean = *Rotation3::from_axis_angle(&Vector3::x_axis(), -draw.between(0.05, 0.3)).matrix();
    let back = block([0.0, 0.0, 0.1], [width * 0.9, 0.06, draw.between(0.4, 0.6)]);
    piece.push(back.moved(&lean, &Vector3::new(0.0, 0.22, seat)));
    if draw.chance(0.6) {
        for side in [-1.0, 1.0] {
            let x = side * (width * 0.5 + 0.02);
            piece.block([x, 0.05, seat], [0.03, 0.05, 0.2]);
            piece.block([x, 0.0, seat + 0.2], [0.06, 0.25, 0.03]);
        }
    }
    piece
}

/// A sofa for two or three with arm rests and cushions, some thrown at odd angles.
pub(in crate::simulate) fn sofa(draw: &mut Draw) -> Piece {
    let width = draw.between(1.5, 2.3);
    upholstered(draw, width)
}

/// A sofa for one.
pub(in crate::simulate) fn armchair(draw: &mut Draw) -> Piece {
    let width = draw.between(0.75, 0.95);
    upholstered(draw, width)
}

fn upholstered(draw: &mut Draw, width: f32) -> Piece {
    let (depth, seat, back) = (draw.between(0.8, 1.0), draw.between(0.38, 0.46), draw.between(0.7, 0.95));
    let (arm, arm_height) = (draw.between(0.12, 0.24), draw.between(0.52, 0.66));
    let mut piece = Piece::new(width, depth, back);
    piece.block([0.0, 0.0, 0.08], [width, depth, seat - 0.2]);
    piece.block([0.0, depth * 0.5 - 0.11, 0.08], [width, 0.22, back - 0.08]);
    for side in [-1.0, 1.0] {
        let x = side * (width - arm) * 0.5;
        piece.block([x, 0.0, 0.08], [arm, depth, arm_height - 0.08 - arm * 0.5]);
        let (y, z) = (depth * 0.5, arm_height - arm * 0.5);
        piece.rod([x, -y, z], [x, y, z], arm * 0.5);
    }
    let places = ((width - 2.0 * arm) / 0.62).round().max(1.0);
    let place = (width - 2.0 * arm) / places;
    for i in 0..places as usize {
        let x = (i as f32 + 0.5) * place - (width - 2.0 * arm) * 0.5;
        piece.block([x, -0.1, seat - 0.12], [place - 0.02, depth - 0.26, draw.between(0.12, 0.16)]);
    }
    for _ in 0..draw.count(0, 3) {
        let turn = Rotation3::from_euler_angles(
            draw.between(-0.9, -0.4),
            draw.between(-0.4, 0.4),
            draw.between(-0.5, 0.5),
        );
        let at =
            Vector3::new(draw.between(-0.5, 0.5) * (width - 2.0 * arm - 0.3), depth * 0.5 - 0.34, seat + 0.2);
        piece.push(block([0.0, 0.0, -0.2], [0.42, 0.12, 0.4]).moved(turn.matrix(), &at));
    }
    piece
}

/// A bed with a headboard, a mattress, pillows and a folded blanket.
pub(in crate::simulate) fn bed(draw: &mut Draw) -> Piece {
    let (width, length, top) =
        (draw.pick([0.95, 1.45, 1.85]), draw.between(2.0, 2.15), draw.between(0.45, 0.6));
    let head = draw.between(0.8, 1.2);
    let mut piece = Piece::new(width, length, head);
    piece.legs(draw, 0.2);
    piece.block([0.0, 0.0, 0.18], [width, length, 0.14]);
    piece.block([0.0, -0.02, 0.32], [width - 0.06, length - 0.1, top - 0.32]);
    piece.block([0.0, length * 0.5 - 0.025, 0.1], [width, 0.05, head - 0.1]);
    let pillows = if width > 1.2 { 2 } else { 1 };
    for i in 0..pillows {
        let x = (i as f32 + 0.5) / pillows as f32 * width - width * 0.5 + draw.between(-0.05, 0.05);
        let turn = Rotation3::from_euler_angles(draw.between(-0.35, -0.1), 0.0, draw.between(-0.3, 0.3));
        let at = Vector3::new(x, length * 0.5 - 0.3, top + 0.06);
        piece.push(block([0.0, 0.0, -0.06], [0.6, 0.4, 0.12]).moved(turn.matrix(), &at));
    }
    let blanket = draw.between(0.4, 1.1);
    let slide = draw.between(-0.08, 0.08);
    piece.block([slide, blanket * 0.5 - length * 0.5, top], [width + 0.02, blanket, draw.between(0.04, 0.1)]);
    piece
}

/// A plain bench.
pub(in crate::simulate) fn bench(draw: &mut Draw) -> Piece {
    let (width, height) = (draw.between(1.0, 1.8), draw.between(0.42, 0.48));
    let mut piece = Piece::new(width, 0.38, height);
    for side in [-1.0, 1.0] {
        piece.block([side * (width * 0.5 - 0.15), 0.0, 0.0], [0.06, 0.34, height - 0.04]);
    }
    for i in 0..3 {
        piece.block([0.0, 0.125 * (i as f32 - 1.0), height - 0.04], [width, 0.1, 0.04]);
    }
    piece
}
