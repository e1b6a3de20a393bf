//! Which furniture a kind of room contains, and where in the room each piece belongs. Used by [`super::furnish`], which places it.

use super::draw::Draw;
use super::furniture::{self as f, Piece};
use super::plan::RoomKind;

/// Makes one piece, never twice the same.
pub(super) type Maker = fn(&mut Draw) -> Piece;

/// What a kind of room contains.
pub(super) struct Suite {
    /// Stand away from the walls, once each, before anything else.
    pub middle: &'static [Maker],
    /// Stand against walls, once each.
    pub needed: &'static [Maker],
    /// Stand against walls.
    pub walls: &'static [Maker],
    /// Stand anywhere, turned by any angle.
    pub free: &'static [Maker],
}

/// The suite of a kind of room.
pub(super) fn suite(kind: RoomKind) -> Suite {
    match kind {
        RoomKind::Office => Suite {
            middle: &[],
            needed: &[f::desk, f::desk, f::shelf],
            walls: &[
                f::desk,
                f::shelf,
                f::cabinet,
                f::drawers,
                f::wardrobe,
                f::plant,
                f::radiator,
                f::carton_stack,
            ],
            free: &[f::desk, f::plant, f::coffee_table, f::office_chair, f::bin, f::carton_stack],
        },
        RoomKind::Meeting => Suite {
            middle: &[f::long_table],
            needed: &[f::cabinet],
            walls: &[f::cabinet, f::shelf, f::plant, f::chair, f::radiator, f::drawers, f::floor_lamp],
            free: &[f::armchair, f::chair, f::plant, f::bin],
        },
        RoomKind::Living => Suite {
            middle: &[f::rug, f::coffee_table],
            needed: &[f::sofa, f::shelf],
            walls: &[
                f::sofa,
                f::shelf,
                f::cabinet,
                f::floor_lamp,
                f::plant,
                f::armchair,
                f::radiator,
                f::drawers,
            ],
            free: &[f::coffee_table, f::armchair, f::dining_table, f::rug, f::plant, f::armchair],
        },
        RoomKind::Kitchen => Suite {
            middle: &[f::dining_table],
            needed: &[f::kitchen_counter],
            walls: &[f::cabinet, f::shelf, f::bin, f::radiator, f::drawers, f::plant],
            free: &[f::dining_table, f::dining_table, f::chair, f::bin],
        },
        RoomKind::Bedroom => Suite {
            middle: &[],
            needed: &[f::bed, f::wardrobe],
            walls: &[f::drawers, f::shelf, f::chair, f::floor_lamp, f::desk, f::radiator, f::plant],
            free: &[f::rug, f::armchair, f::chair, f::carton_stack],
        },
        RoomKind::Storage => Suite {
            middle: &[f::rack],
            needed: &[f::rack, f::rack],
            walls: &[f::rack, f::rack, f::shelf, f::carton_stack, f::wardrobe, f::carton_stack],
            free: &[f::rack, f::carton_stack, f::carton_stack, f::bin, f::chair],
        },
        RoomKind::Passage => Suite {
            middle: &[],
            needed: &[],
            walls: &[
                f::bench,
                f::cabinet,
                f::plant,
                f::bin,
                f::radiator,
                f::carton_stack,
                f::chair,
                f::drawers,
            ],
            free: &[],
        },
        RoomKind::Warehouse => Suite {
            middle: &[],
            needed: &[f::desk],
            walls: &[f::cabinet, f::carton_stack, f::pallet, f::bench, f::bin],
            free: &[f::pallet, f::carton_stack, f::bin],
        },
        RoomKind::Hall => Suite {
            middle: &[],
            needed: &[],
            walls: &[f::bench, f::radiator, f::plant, f::cabinet, f::bench],
            free: &[f::plant, f::bin, f::chair],
        },
    }
}
