//! Map thinning: removes redundant keyframes, whose ground is also covered by others.
//!
//! The ground is divided into cells, and each keyframe covers some of them. The keyframe whose
//! cells are covered by the most other keyframes is removed repeatedly. Edges through it are
//! composed to edges between its neighbours, so that the pose graph stays connected.

use crate::markers::MapMarker;
use nalgebra::Vector4;
use odograph::camera::Camera;
use odograph::geometry::pose_index::{LN_SCALE, X, Y};
use odograph::geometry::{GroundPose, Pixel, Sim2, WithCovariance};
use odograph::ground_map::GroundMap;
use odograph::keyframe::{EdgeKind, KeyframeId, MapEdge, relative_pose};
use odograph::numerics::median;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

/// Sample points per image side that determine the covered cells: more follow the outline better
/// and take longer.
const GRID: usize = 9;
/// Cells per side of a typical footprint: more keep keyframes for smaller patches of ground.
const CELLS: f64 = 6.0;

/// Result of thinning a map.
#[derive(Debug, Clone, PartialEq)]
pub struct Thinning {
    /// Removed keyframes, in the order of their removal.
    pub gone: Vec<KeyframeId>,
    /// Composed edges between remaining keyframes.
    pub edges: Vec<MapEdge>,
    /// Fraction of the covered ground that remains covered.
    pub ground_kept: f64,
    /// Of each removed keyframe that had an edge, in the order of their removal, the neighbour that
    /// takes over its markers.
    heirs: Vec<Heir>,
}

/// The neighbour of a removed keyframe.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Heir {
    gone: KeyframeId,
    keyframe: KeyframeId,
    /// From the metres of the removed keyframe to those of its neighbour.
    keyframe_from_gone: WithCovariance<Sim2, 4>,
}

impl Thinning {
    /// Gives the markers of the removed keyframes to their neighbours.
    pub(crate) fn hand_over(&self, markers: &mut [MapMarker]) {
        for Heir { gone, keyframe, keyframe_from_gone } in &self.heirs {
            for MapMarker { placed, .. } in markers.iter_mut() {
                if placed.sighting.keyframe == *gone {
                    placed.sighting = placed.sighting.moved_to(*keyframe, keyframe_from_gone);
                }
            }
        }
    }
}

/// Thins a map to at most `most` keyframes.
pub(crate) fn thinning(map: &GroundMap, most: usize) -> Thinning {
    let mut coverage = KeyframeCoverage::of(map);
    let mut ties = Ties::of(map);
    let (mut gone, mut heirs) = (Vec::new(), Vec::new());
    // Lazy priority queue: costs only increase as keyframes are removed, so an outdated cost is a
    // lower bound.
    let mut queue: BinaryHeap<Reverse<(u64, usize)>> =
        (0..map.keyframes.len()).map(|index| Reverse((coverage.cost(index), index))).collect();
    while map.keyframes.len() - gone.len() > most {
        let Some(Reverse((known, index))) = queue.pop() else { break };
        let cost = coverage.cost(index);
        if cost > known {
            queue.push(Reverse((cost, index)));
            continue;
        }
        coverage.take_out(index);
        heirs.extend(ties.take_out(map.keyframes[index].id));
        gone.push(map.keyframes[index].id);
    }
    Thinning { gone, edges: ties.composed(), ground_kept: coverage.kept(), heirs }
}

/// The edges of a map without some of its keyframes: edges through these are composed.
pub(crate) fn edges_without(map: &GroundMap, gone: &[KeyframeId]) -> Vec<MapEdge> {
    let mut ties = Ties::of(map);
    for &keyframe in gone {
        ties.take_out(keyframe);
    }
    ties.edges.into_iter().flatten().collect()
}

/// Cells covered by each keyframe, and the number of keyframes that cover each cell.
struct KeyframeCoverage {
    cells: Vec<Vec<usize>>,
    counts: Vec<u32>,
}

impl KeyframeCoverage {
    fn of(map: &GroundMap) -> Self {
        let points: Vec<Vec<(f64, f64)>> = map
            .keyframes
            .iter()
            .map(|keyframe| shown(map.camera_of(keyframe.session), &keyframe.pose))
            .collect();
        let mut widths: Vec<f64> = points.iter().map(|points| width(points)).collect();
        let side = median(&mut widths).map_or(1.0, |width| (width / CELLS).max(1e-6));
        let mut numbers = BTreeMap::new();
        let mut counts = Vec::new();
        let cells = points
            .iter()
            .map(|points| {
                let touched: BTreeSet<(i64, i64)> = points
                    .iter()
                    .map(|(x, y)| ((x / side).floor() as i64, (y / side).floor() as i64))
                    .collect();
                let cells: Vec<usize> = touched
                    .into_iter()
                    .map(|cell| {
                        let next = numbers.len();
                        *numbers.entry(cell).or_insert(next)
                    })
                    .collect();
                counts.resize(numbers.len(), 0);
                cells.iter().for_each(|&cell| counts[cell] += 1);
                cells
            })
            .collect();
        Self { cells, counts }
    }

    /// Cost of removing a keyframe: decreases for each of its cells with the third power of the
    /// number of keyframes that cover it. In millionths of a cell, as an integer, to compare
    /// exactly.
    fn cost(&self, index: usize) -> u64 {
        self.cells[index].iter().map(|&cell| 1_000_000 / u64::from(self.counts[cell].max(1)).pow(3)).sum()
    }

    fn take_out(&mut self, index: usize) {
        for &cell in &self.cells[index] {
            self.counts[cell] -= 1;
        }
    }

    fn kept(&self) -> f64 {
        let kept = self.counts.iter().filter(|&&count| count > 0).count();
        kept as f64 / self.counts.len().max(1) as f64
    }
}

/// Ground points seen by a camera, for a grid of pixels.
fn shown(camera: &Camera, pose: &GroundPose) -> Vec<(f64, f64)> {
    let at = |k: usize, size: usize| (k as f64 + 0.5) / GRID as f64 * (size as f64 - 1.0);
    let pixels =
        (0..GRID * GRID).map(|k| Pixel::new(at(k % GRID, camera.width()), at(k / GRID, camera.height())));
    let points = pixels.filter_map(|pixel| pose.ground_from_ray(camera.ray_from_pixel(pixel)?));
    // Excludes distant ground towards the horizon.
    let near = |(x, y): &(f64, f64)| (x - pose.x_m).hypot(y - pose.y_m) < 4.0 * pose.height_m;
    points.map(|point| (point.x_m, point.y_m)).filter(near).collect()
}

fn width(points: &[(f64, f64)]) -> f64 {
    let range = |values: &mut dyn Iterator<Item = f64>| {
        let (low, high) =
            values.fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(value), high.max(value)));
        (high - low).max(0.0)
    };
    range(&mut points.iter().map(|p| p.0)).max(range(&mut points.iter().map(|p| p.1)))
}

/// Edges of the pose graph during thinning.
struct Ties {
    edges: Vec<Option<MapEdge>>,
    at: BTreeMap<KeyframeId, BTreeSet<usize>>,
    /// Height at which each keyframe's motions were measured, metres.
    measured_at_m: BTreeMap<KeyframeId, f64>,
    /// Number of edges of the original map.
    before: usize,
}

impl Ties {
    fn of(map: &GroundMap) -> Self {
        let mut at: BTreeMap<KeyframeId, BTreeSet<usize>> = BTreeMap::new();
        for (number, edge) in map.edges.iter().enumerate() {
            at.entry(edge.from).or_default().insert(number);
            at.entry(edge.to).or_default().insert(number);
        }
        let height =
            |keyframe: &odograph::ground_map::MapKeyframe| (keyframe.id, keyframe.odometry_pose.height_m);
        Self {
            edges: map.edges.iter().copied().map(Some).collect(),
            at,
            measured_at_m: map.keyframes.iter().map(height).collect(),
            before: map.edges.len(),
        }
    }

    /// Removes a keyframe and connects its neighbours to the one with the least uncertain edge to
    /// it, which is returned.
    fn take_out(&mut self, keyframe: KeyframeId) -> Option<Heir> {
        let mut best: BTreeMap<KeyframeId, MapEdge> = BTreeMap::new();
        for number in self.at.remove(&keyframe).unwrap_or_default() {
            let Some(edge) = self.edges[number].take() else { continue };
            let edge = if edge.from == keyframe { edge } else { self.reversed(&edge) };
            if let Some(edges) = self.at.get_mut(&edge.to) {
                edges.remove(&number);
            }
            let known = best.entry(edge.to).or_insert(edge);
            if spread(&edge) < spread(known) {
                *known = edge;
            }
        }
        let hub = best.values().min_by(|a, b| spread(a).total_cmp(&spread(b))).copied()?;
        let to_keyframe = self.reversed(&hub);
        for edge in best.values().filter(|edge| edge.to != hub.to) {
            if !self.tied(hub.to, edge.to) {
                let number = self.edges.len();
                self.edges.push(Some(self.composed_of(&to_keyframe, edge)));
                self.at.entry(hub.to).or_default().insert(number);
                self.at.entry(edge.to).or_default().insert(number);
            }
        }
        let keyframe_from_gone = self.similarity(&to_keyframe);
        Some(Heir { gone: keyframe, keyframe: hub.to, keyframe_from_gone })
    }

    fn tied(&self, one: KeyframeId, other: KeyframeId) -> bool {
        let edges = self.at.get(&one).into_iter().flatten().filter_map(|&number| self.edges[number]);
        edges.into_iter().any(|edge| edge.from == other || edge.to == other)
    }

    fn composed(self) -> Vec<MapEdge> {
        self.edges.into_iter().skip(self.before).flatten().collect()
    }

    /// The heights at which the two ends of an edge measure.
    fn measured_m(&self, edge: &MapEdge) -> [f64; 2] {
        [edge.from, edge.to].map(|keyframe| self.measured_at_m.get(&keyframe).copied().unwrap_or(1.0))
    }

    /// Between the metres of the two ends of an edge.
    fn similarity(&self, edge: &MapEdge) -> WithCovariance<Sim2, 4> {
        let transform = relative_pose::similarity(&edge.motion, self.measured_m(edge));
        WithCovariance { transform, covariance: edge.covariance }
    }

    /// Inverse of an edge, with its covariance propagated.
    fn reversed(&self, edge: &MapEdge) -> MapEdge {
        MapEdge {
            from: edge.to,
            to: edge.from,
            kind: edge.kind,
            motion: relative_pose::inverse(&edge.motion, self.measured_m(edge)),
            covariance: self.similarity(edge).inverse().covariance,
        }
    }

    /// Composition of two consecutive edges, with their covariances propagated.
    fn composed_of(&self, first: &MapEdge, second: &MapEdge) -> MapEdge {
        let WithCovariance { transform: relative, covariance } =
            self.similarity(first) * self.similarity(second);
        let ln_heights = first.motion[LN_SCALE] + second.motion[LN_SCALE];
        let kind = match (first.kind, second.kind) {
            (EdgeKind::Gap, _) | (_, EdgeKind::Gap) => EdgeKind::Gap,
            (EdgeKind::Odometry, EdgeKind::Odometry) => EdgeKind::Odometry,
            _ => EdgeKind::Loop,
        };
        MapEdge {
            from: first.from,
            to: second.to,
            kind,
            motion: Vector4::new(relative.x_m, relative.y_m, relative.heading_rad, ln_heights),
            covariance,
        }
    }
}

/// Trace of an edge's position covariance, m².
fn spread(edge: &MapEdge) -> f64 {
    edge.covariance[(X, X)] + edge.covariance[(Y, Y)]
}

#[cfg(test)]
mod tests;
