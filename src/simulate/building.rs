//! A furnished building drawn from a seed: the scene that rays meet, and where one can stand in it.
//! Uses the plan, the walls and the furniture; used by the survey and its stations.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::draw::Draw;
use super::footprint::Footprint;
use super::furnish::{Furniture, furnish};
use super::hazards::{Hazards, darken, glaze, hazardous};
use super::openings::Doorway;
use super::plan::{Layout, Room, draw_plan};
use super::scene::Scene;
use super::solid::{Ray, Solid};
use super::walls::shell;
use crate::control::Seed;

/// What to build.
#[derive(Debug, Clone, PartialEq)]
pub struct BuildingOptions {
    /// How the rooms are arranged.
    pub layout: Layout,
    /// Number of rooms, a corridor not counted; a hall has one.
    pub rooms: usize,
    /// Shortest and longest edge of a room, metres. A hall's edges are two to three of the longest.
    pub room_size: [f32; 2],
    /// How much stands in the rooms: 0 is empty, 1 is usual, 2 is packed.
    pub density: f32,
    /// Share of the furniture that stands elsewhere at a second visit, 0 to 1. Stations are chosen by what they see at the first.
    pub moved: f32,
    /// What makes scans disagree about free space.
    pub hazards: Hazards,
}

impl Default for BuildingOptions {
    fn default() -> Self {
        Self {
            layout: Layout::Office,
            rooms: 6,
            room_size: [4.0, 7.0],
            density: 1.0,
            moved: 0.0,
            hazards: Hazards::default(),
        }
    }
}

/// Why options describe no building.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum BuildingError {
    /// None, or more than a survey can handle.
    #[error("a building has 1 to 200 rooms, not {0}")]
    Rooms(usize),
    /// Rooms too small to stand in, too large to see across, or an empty interval.
    #[error("room edges must lie between 2.5 m and 20 m, the shortest first, not {0} m to {1} m")]
    RoomSize(f32, f32),
    /// Negative, not a number, or more than fits.
    #[error("the density of furniture must lie between 0 and 3, not {0}")]
    Density(f32),
    /// Negative, not a number, or more than all.
    #[error("the share of {0} must lie between 0 and 1, not {1}")]
    Share(&'static str, f32),
}

impl BuildingOptions {
    /// Checks that every value lies in the range that its documentation gives.
    pub fn validate(&self) -> Result<(), BuildingError> {
        if !(1..=200).contains(&self.rooms) {
            return Err(BuildingError::Rooms(self.rooms));
        }
        let [small, large] = self.room_size;
        if !(small >= 2.5 && large >= small && large <= 20.0) {
            return Err(BuildingError::RoomSize(small, large));
        }
        if !(0.0..=3.0).contains(&self.density) {
            return Err(BuildingError::Density(self.density));
        }
        if let Some((hazard, share)) = self.hazards.first_wrong() {
            return Err(BuildingError::Share(hazard, share));
        }
        if !(0.0..=1.0).contains(&self.moved) {
            return Err(BuildingError::Share("moved furniture", self.moved));
        }
        Ok(())
    }
}

/// A furnished building. World frame: floor at z = 0, z up, metres.
#[derive(Debug, Clone)]
pub struct Building {
    /// Everything that a ray can meet.
    pub scene: Scene,
    /// The same at a second visit, if furniture has been moved by then.
    pub later: Option<Scene>,
    /// The insides of the rooms.
    pub rooms: Vec<Room>,
    /// The passages that link the rooms.
    pub doorways: Vec<Doorway>,
    /// Of the furniture at all visits.
    footprints: Vec<Footprint>,
}

impl Building {
    /// Draws a building: the same for the same options and seed.
    pub fn new(options: &BuildingOptions, seed: Seed) -> Result<Self, BuildingError> {
        options.validate()?;
        let mut plan = draw_plan(options.layout, options.rooms, options.room_size, seed);
        glaze(&mut plan, &options.hazards, seed);
        let furnished: Vec<[Furniture; 2]> = plan
            .rooms
            .par_iter()
            .map(|room| {
                let draw = |purpose| Draw::new(seed.derive(purpose, u128::from(room.identity)));
                let mut visits = furnish(room, &plan, options.density, options.moved, seed);
                for Furniture { solids, .. } in &mut visits {
                    darken(solids, options.hazards.dark, &mut draw("simulate.dark"));
                    paint(solids, [40, 230], &mut draw("simulate.paint"));
                }
                visits
            })
            .collect();
        let mut solids = shell(&plan);
        solids.extend(hazardous(&plan, &options.hazards, seed));
        paint(&mut solids, [170, 240], &mut Draw::new(seed.derive("simulate.paint", u128::MAX)));
        let scene_at = |visit: usize| {
            let furniture = furnished.iter().flat_map(|visits| &visits[visit].solids);
            Scene::new(&solids.iter().chain(furniture).cloned().collect::<Vec<_>>())
        };
        let later = (options.moved > 0.0).then(|| scene_at(1));
        let visits = 1 + usize::from(later.is_some());
        let footprints =
            furnished.iter().flat_map(|all| &all[..visits]).flat_map(|one| one.footprints.clone()).collect();
        Ok(Self { scene: scene_at(0), later, rooms: plan.rooms, doorways: plan.doorways, footprints })
    }

    /// What a ray can meet at a visit, from 0.
    #[must_use]
    pub fn scene_at(&self, visit: usize) -> &Scene {
        self.later.as_ref().filter(|_| visit > 0).unwrap_or(&self.scene)
    }

    /// Whether a place is inside a room or a doorway and at least `clearance` metres away from every surface, at any visit.
    ///
    /// Walls and furniture are probed by rays into `PROBES` directions, so a thin rod may stand a little closer.
    #[must_use]
    pub fn is_clear(&self, place: &Vector3<f32>, clearance: f32) -> bool {
        self.is_free_floor([place.x, place.y], clearance)
            && probes().all(|direction| {
                let ray = Ray { origin: *place, direction };
                [Some(&self.scene), self.later.as_ref()]
                    .into_iter()
                    .flatten()
                    .all(|scene| scene.cast(&ray, 0.0, clearance).is_none())
            })
    }

    /// Whether a circle on the floor lies outside all furniture, and its centre inside a room or a doorway.
    #[must_use]
    pub fn is_free_floor(&self, [x, y]: [f32; 2], radius: f32) -> bool {
        let in_room = self
            .rooms
            .iter()
            .any(|room| room.low[0] < x && x < room.high[0] && room.low[1] < y && y < room.high[1]);
        let in_doorway = self.doorways.iter().any(|doorway| {
            let offset = [x - doorway.centre[0], y - doorway.centre[1]];
            offset[doorway.axis].abs() < doorway.width * 0.5 && offset[1 - doorway.axis].abs() < 0.3
        });
        (in_room || in_doorway) && self.footprints.iter().all(|footprint| !footprint.reaches([x, y], radius))
    }
}

/// Gives every solid a colour of its own, each channel in an interval.
fn paint(solids: &mut [Solid], [low, high]: [usize; 2], draw: &mut Draw) {
    for solid in solids {
        solid.color = [(); 3].map(|()| draw.count(low, high) as u8);
    }
}

/// Directions in which [`Building::is_clear`] looks.
const PROBES: usize = 128;

/// Directions spread evenly over the sphere: a Fibonacci lattice.
fn probes() -> impl Iterator<Item = Vector3<f32>> {
    directions(PROBES)
}

/// `count` unit vectors spread evenly over the sphere: a Fibonacci lattice.
pub(super) fn directions(count: usize) -> impl Iterator<Item = Vector3<f32>> {
    let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
    (0..count).map(move |i| {
        let z = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
        let radius = (1.0 - z * z).sqrt();
        let (sin, cos) = (golden * i as f32).sin_cos();
        Vector3::new(radius * cos, radius * sin, z)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rooms_are_closed_but_for_doors_and_windows() {
        for layout in [
            Layout::Office,
            Layout::House,
            Layout::Corridor,
            Layout::TwinRooms,
            Layout::Hall,
            Layout::Warehouse,
        ] {
            let options = BuildingOptions { layout, density: 0.0, ..BuildingOptions::default() };
            let building = Building::new(&options, Seed(5)).unwrap();
            for room in &building.rooms {
                let [x, y] = room.centre();
                // Above doors and windows no ray may leave the room.
                let eye = Vector3::new(x, y, room.height - 0.1);
                let reach = room.size()[0].hypot(room.size()[1]) + 1.0;
                for direction in directions(500).filter(|d| d.z.abs() < 0.001 || d.z > 0.0) {
                    let hit = building.scene.cast(&Ray { origin: eye, direction }, 0.0, reach);
                    assert!(hit.is_some(), "{layout:?}: a hole in {room:?} towards {direction}");
                }
                let down = building.scene.cast(&Ray { origin: eye, direction: -Vector3::z() }, 0.0, reach);
                assert!((down.unwrap().distance - eye.z).abs() < 0.02);
            }
        }
    }

    #[test]
    fn furniture_makes_rooms_distinct_and_twin_rooms_alike() {
        let profile = |building: &Building, room: &Room| -> Vec<f32> {
            let [x, y] = room.centre();
            let sign = if room.turned { -1.0 } else { 1.0 };
            directions(300)
                .map(|d| Vector3::new(sign * d.x, sign * d.y, -d.z.abs()))
                .filter(|d| d.z < -0.35)
                .filter_map(|direction| {
                    building.scene.cast(&Ray { origin: Vector3::new(x, y, 2.0), direction }, 0.0, 30.0)
                })
                .map(|hit| hit.distance)
                .collect()
        };
        for (layout, alike) in [(Layout::TwinRooms, true), (Layout::Corridor, false)] {
            let options = BuildingOptions { layout, ..BuildingOptions::default() };
            let building = Building::new(&options, Seed(2)).unwrap();
            let rooms: Vec<&Room> = building
                .rooms
                .iter()
                .filter(|room| room.kind != super::super::plan::RoomKind::Passage)
                .collect();
            for pair in rooms.windows(2) {
                let (a, b) = (profile(&building, pair[0]), profile(&building, pair[1]));
                let same = a.iter().zip(&b).filter(|(a, b)| (*a - *b).abs() < 0.01).count();
                assert_eq!(same > a.len() * 95 / 100, alike, "{layout:?}: {same} of {} alike", a.len());
            }
        }
    }

    #[test]
    fn options_out_of_range_are_refused() {
        let wrong = |options: BuildingOptions| Building::new(&options, Seed(0)).map(|_| ()).unwrap_err();
        let usual = BuildingOptions::default();
        assert_eq!(wrong(BuildingOptions { rooms: 0, ..usual.clone() }), BuildingError::Rooms(0));
        let size = [5.0, 4.0];
        assert_eq!(
            wrong(BuildingOptions { room_size: size, ..usual.clone() }),
            BuildingError::RoomSize(5.0, 4.0)
        );
        assert!(matches!(wrong(BuildingOptions { density: f32::NAN, ..usual }), BuildingError::Density(_)));
    }
}
