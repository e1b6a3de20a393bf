//! What the truth says about the scans of a survey: what each pair has in common, and in which room each scan was taken. With it one
//! can tell whether the data decide where a scan belongs. Used by the command line, by calibration and by tests.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::overlap::Neighbourhood;
use super::solid::{Material, Ray};
use super::survey::{APART, SimulatedScan, Survey};
use crate::geometry::Pose;

/// Points of a scan that are asked whether the other sensor saw them.
const SAMPLE: usize = 1500;
/// A surface this much nearer than a point hides it, metres.
const SLACK: f32 = 0.06;

impl Survey {
    /// Share of the points of scan `of` that lie within `tolerance` metres of a point of scan `with` under the truth.
    ///
    /// The tolerance should exceed the spacing of the points. `None` if there is no such scan.
    #[must_use]
    pub fn overlap(&self, of: usize, with: usize, tolerance: f32) -> Option<f64> {
        let (of, with) = (self.scans.get(of)?, self.scans.get(with)?);
        let index = Neighbourhood::new(&with.cloud, &with.model_from_scan, tolerance);
        Some(index.share_of(&of.cloud, &of.model_from_scan))
    }

    /// [`Survey::overlap`] of all pairs: row `of`, column `with`.
    #[must_use]
    pub fn overlaps(&self, tolerance: f32) -> Vec<Vec<f64>> {
        let columns: Vec<Vec<f64>> = self
            .scans
            .par_iter()
            .map(|with| {
                let index = Neighbourhood::new(&with.cloud, &with.model_from_scan, tolerance);
                self.scans.iter().map(|of| index.share_of(&of.cloud, &of.model_from_scan)).collect()
            })
            .collect();
        (0..self.scans.len()).map(|of| columns.iter().map(|column| column[of]).collect()).collect()
    }

    /// Share of the points of each scan that each other scan saw, too: row `of`, column `by`.
    ///
    /// A point counts when it has a neighbour within `tolerance` metres in the other scan and nothing stands between it and the
    /// other sensor, so that the two sides of a wall are not taken for one. What is seen in a mirror is not there.
    #[must_use]
    pub fn shared_views(&self, tolerance: f32) -> Vec<Vec<f64>> {
        let columns: Vec<Vec<f64>> = self
            .scans
            .par_iter()
            .map(|by| {
                let index = Neighbourhood::new(&by.cloud, &Pose::identity(), tolerance);
                self.scans.iter().map(|of| self.share_seen(of, by, &index)).collect()
            })
            .collect();
        (0..self.scans.len()).map(|of| columns.iter().map(|column| column[of]).collect()).collect()
    }

    fn share_seen(&self, of: &SimulatedScan, by: &SimulatedScan, index_of_by: &Neighbourhood) -> f64 {
        let Some(building) = self.buildings.get(by.building).filter(|_| of.building == by.building) else {
            return 0.0;
        };
        let by_from_of = by.model_from_scan.inverse() * of.model_from_scan;
        let building_from_by = Pose::from_translation(-place_of(by.building)) * by.model_from_scan;
        let rotation = building_from_by.rotation.matrix().cast::<f32>();
        let eye: Vector3<f32> = building_from_by.translation.cast();
        let seen = |point: &[f32; 3]| {
            let point = Vector3::from(by_from_of.transform_point(*point));
            let distance = point.norm();
            let ray = Ray { origin: eye, direction: rotation * (point / distance.max(1e-6)) };
            index_of_by.around(&point).next().is_some()
                && building
                    .scene_at(by.visit)
                    .cast(&ray, 0.0, distance - SLACK)
                    .is_none_or(|hit| hit.material == Material::Glass)
        };
        let sample: Vec<_> = of.cloud.points.iter().step_by(of.cloud.len().div_ceil(SAMPLE).max(1)).collect();
        sample.iter().filter(|point| seen(point)).count() as f64 / sample.len().max(1) as f64
    }

    /// The room of its building in which a scan was taken; `None` in a doorway.
    #[must_use]
    pub fn room_of(&self, scan: &SimulatedScan) -> Option<usize> {
        let at = scan.model_from_scan.translation - place_of(scan.building);
        let inside = |k: usize, low: f32, high: f32| (f64::from(low)..f64::from(high)).contains(&at[k]);
        let rooms = &self.buildings.get(scan.building)?.rooms;
        rooms.iter().position(|room| (0..2).all(|k| inside(k, room.low[k], room.high[k])))
    }

    /// This survey and one of other buildings as one, with the scans of both mixed: a folder that holds what does not belong together.
    #[must_use]
    pub fn beside(mut self, other: Self) -> Self {
        let first = self.buildings.len();
        let place = Pose::from_translation(place_of(first));
        self.buildings.extend(other.buildings);
        for mut scan in other.scans {
            while self.scans.iter().any(|known| known.name == scan.name) {
                scan.name.push('0');
            }
            scan.building += first;
            scan.model_from_scan = place * scan.model_from_scan;
            self.scans.push(scan);
        }
        self.scans.sort_by(|a, b| a.name.cmp(&b.name));
        self
    }
}

/// Where the origin of a building lies in the model frame.
fn place_of(building: usize) -> Vector3<f64> {
    Vector3::new(APART * building as f64, 0.0, 0.0)
}

#[cfg(test)]
mod tests {
    use crate::control::Seed;
    use crate::simulate::{BuildingOptions, Layout, Sensor, SurveyOptions, simulate};

    #[test]
    fn scans_on_two_sides_of_a_wall_share_nothing_and_scans_of_a_room_share_much() {
        let options = SurveyOptions {
            building: BuildingOptions {
                layout: Layout::TwinRooms,
                rooms: 4,
                density: 0.3,
                ..Default::default()
            },
            sensor: Sensor::panoramic(12_000),
            stations: 10,
            seed: Seed(2),
            ..Default::default()
        };
        let survey = simulate(&options).unwrap();
        let (near, seen) = (survey.overlaps(0.25), survey.shared_views(0.25));
        let mut apart = 0;
        for (i, of) in survey.scans.iter().enumerate() {
            assert!(seen[i][i] > 0.9, "a scan shares {} with itself", seen[i][i]);
            for (j, by) in survey.scans.iter().enumerate() {
                assert!(seen[i][j] <= near[i][j] + 0.05);
                match (survey.room_of(of), survey.room_of(by)) {
                    (Some(a), Some(b)) if a == b && i != j => assert!(seen[i][j] > 0.3, "{}", seen[i][j]),
                    (Some(_), Some(_)) => apart += usize::from(near[i][j] > 0.05 && seen[i][j] < 0.02),
                    _ => {}
                }
            }
        }
        assert!(apart > 0, "no pair is only near through a wall");
    }

    #[test]
    fn a_scan_shares_all_with_itself_at_any_visit() {
        let building = BuildingOptions { rooms: 2, moved: 1.0, ..Default::default() };
        let sensor = Sensor::panoramic(6000);
        let options = SurveyOptions { building, sensor, stations: 6, seed: Seed(4), ..Default::default() };
        let seen = simulate(&options).unwrap().shared_views(0.25);
        for (i, row) in seen.iter().enumerate() {
            assert!(row[i] > 0.95, "scan {i} shares {} with itself", row[i]);
        }
    }
}
