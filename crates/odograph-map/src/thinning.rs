//! Which keyframes a map can do without: those whose ground others show as well.
//!
//! The ground is divided into cells, and each keyframe covers some of them. Again and again the keyframe goes whose cells are covered by the most
//! others. What tied the map together through it is composed into edges between its neighbours, so that no piece comes apart.

use nalgebra::{Matrix4, Matrix4x2, Vector2, Vector4};
use odograph::camera::Camera;
use odograph::geometry::{GroundPose, Pixel};
use odograph::mapping::{EdgeKind, GroundMap, KeyframeId, MapEdge};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

/// Points of an image on each side that say which cells it covers.
const GRID: usize = 9;
/// Cells on a side of a typical footprint.
const CELLS: f64 = 6.0;

/// What is to be taken out of a map, and put in.
#[derive(Debug, Clone, PartialEq)]
pub struct Thinning {
    /// The keyframes that go, in the order in which they were chosen.
    pub gone: Vec<KeyframeId>,
    /// The composed edges between keyframes that stay.
    pub edges: Vec<MapEdge>,
    /// Share of the ground that is still shown by a keyframe.
    pub ground_kept: f64,
}

/// Thins a map to at most so many keyframes.
pub(crate) fn thinning(map: &GroundMap, most: usize) -> Thinning {
    let mut coverage = Coverage::of(map);
    let mut ties = Ties::of(map);
    let mut gone = Vec::new();
    // Costs only grow as keyframes go: a cost that was right when it was put in is a lower bound.
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
        ties.take_out(map.keyframes[index].id);
        gone.push(map.keyframes[index].id);
    }
    Thinning { gone, edges: ties.composed(), ground_kept: coverage.kept() }
}

/// Which keyframes cover which cells.
struct Coverage {
    cells: Vec<Vec<usize>>,
    counts: Vec<u32>,
}

impl Coverage {
    fn of(map: &GroundMap) -> Self {
        let points: Vec<Vec<(f64, f64)>> =
            map.keyframes.iter().map(|keyframe| shown(&map.camera, &keyframe.pose)).collect();
        let mut widths: Vec<f64> = points.iter().map(|points| width(points)).collect();
        widths.sort_by(f64::total_cmp);
        let side = widths.get(widths.len() / 2).map_or(1.0, |width| (width / CELLS).max(1e-6));
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

    /// What is lost where a keyframe goes: for each of its cells the more, the fewer others cover it. In millionths of a cell, so that it can be compared
    /// without rounding.
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

/// Points of the ground that a camera sees, in a grid over its image.
fn shown(camera: &Camera, pose: &GroundPose) -> Vec<(f64, f64)> {
    let at = |k: usize, size: usize| (k as f64 + 0.5) / GRID as f64 * (size as f64 - 1.0);
    let pixels =
        (0..GRID * GRID).map(|k| Pixel::new(at(k % GRID, camera.width()), at(k / GRID, camera.height())));
    let points = pixels.filter_map(|pixel| pose.ground_from_ray(camera.ray_from_pixel(pixel)?));
    // What lies towards the horizon does not count.
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

/// The edges while keyframes go.
struct Ties {
    edges: Vec<Option<MapEdge>>,
    at: BTreeMap<KeyframeId, BTreeSet<usize>>,
    /// Height at which each keyframe's motions were measured, metres.
    measured_at_m: BTreeMap<KeyframeId, f64>,
    /// How many edges the map had.
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
            |keyframe: &odograph::mapping::MapKeyframe| (keyframe.id, keyframe.odometry_pose.height_m);
        Self {
            edges: map.edges.iter().copied().map(Some).collect(),
            at,
            measured_at_m: map.keyframes.iter().map(height).collect(),
            before: map.edges.len(),
        }
    }

    /// Takes a keyframe out; its neighbours are tied to the one that is known best from it.
    fn take_out(&mut self, keyframe: KeyframeId) {
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
        let Some(hub) = best.values().min_by(|a, b| spread(a).total_cmp(&spread(b))).copied() else { return };
        let to_keyframe = self.reversed(&hub);
        for edge in best.values().filter(|edge| edge.to != hub.to) {
            if !self.tied(hub.to, edge.to) {
                let number = self.edges.len();
                self.edges.push(Some(self.composed_of(&to_keyframe, edge)));
                self.at.entry(hub.to).or_default().insert(number);
                self.at.entry(edge.to).or_default().insert(number);
            }
        }
    }

    fn tied(&self, one: KeyframeId, other: KeyframeId) -> bool {
        let edges = self.at.get(&one).into_iter().flatten().filter_map(|&number| self.edges[number]);
        edges.into_iter().any(|edge| edge.from == other || edge.to == other)
    }

    fn composed(self) -> Vec<MapEdge> {
        self.edges.into_iter().skip(self.before).flatten().collect()
    }

    /// How many of the metres that `from` measures are one that `to` measures.
    fn metres_of(&self, edge: &MapEdge) -> f64 {
        let height = |keyframe| self.measured_at_m.get(keyframe).copied().unwrap_or(1.0);
        edge.motion[3].exp() * height(&edge.from) / height(&edge.to)
    }

    /// The same edge seen from its other end.
    fn reversed(&self, edge: &MapEdge) -> MapEdge {
        let metres = self.metres_of(edge);
        let (sin, cos) = edge.motion[2].sin_cos();
        let back = |v: Vector2<f64>| Vector2::new(cos * v.x + sin * v.y, cos * v.y - sin * v.x) / metres;
        let there = Vector2::new(edge.motion[0], edge.motion[1]);
        let here = -back(there);
        let mut by = Matrix4::identity() * -1.0;
        let (along, across) = (-back(Vector2::x()), -back(Vector2::y()));
        by.fixed_view_mut::<2, 1>(0, 0).copy_from(&along);
        by.fixed_view_mut::<2, 1>(0, 1).copy_from(&across);
        // Turned by a little more, the way back turns the other way; seen from higher, it is shorter.
        by.fixed_view_mut::<2, 1>(0, 2).copy_from(&Vector2::new(here.y, -here.x));
        by.fixed_view_mut::<2, 1>(0, 3).copy_from(&-here);
        MapEdge {
            from: edge.to,
            to: edge.from,
            kind: edge.kind,
            motion: Vector4::new(here.x, here.y, -edge.motion[2], -edge.motion[3]),
            covariance: by * edge.covariance * by.transpose(),
        }
    }

    /// One edge after another: from where the first begins to where the second ends.
    fn composed_of(&self, first: &MapEdge, second: &MapEdge) -> MapEdge {
        let metres = self.metres_of(first);
        let (sin, cos) = first.motion[2].sin_cos();
        let turned = |v: Vector2<f64>| metres * Vector2::new(cos * v.x - sin * v.y, sin * v.x + cos * v.y);
        let further = turned(Vector2::new(second.motion[0], second.motion[1]));
        let mut by_first = Matrix4::identity();
        by_first.fixed_view_mut::<2, 1>(0, 2).copy_from(&Vector2::new(-further.y, further.x));
        by_first.fixed_view_mut::<2, 1>(0, 3).copy_from(&further);
        let mut by_second = Matrix4::identity();
        let mut corner = Matrix4x2::zeros();
        corner.fixed_view_mut::<2, 1>(0, 0).copy_from(&turned(Vector2::x()));
        corner.fixed_view_mut::<2, 1>(0, 1).copy_from(&turned(Vector2::y()));
        by_second.fixed_columns_mut::<2>(0).copy_from(&corner);
        let kind = match (first.kind, second.kind) {
            (EdgeKind::Gap, _) | (_, EdgeKind::Gap) => EdgeKind::Gap,
            (EdgeKind::Odometry, EdgeKind::Odometry) => EdgeKind::Odometry,
            _ => EdgeKind::Loop,
        };
        MapEdge {
            from: first.from,
            to: second.to,
            kind,
            motion: Vector4::new(
                first.motion[0] + further.x,
                first.motion[1] + further.y,
                first.motion[2] + second.motion[2],
                first.motion[3] + second.motion[3],
            ),
            covariance: by_first * first.covariance * by_first.transpose()
                + by_second * second.covariance * by_second.transpose(),
        }
    }
}

/// How badly an edge knows where its other end is, m².
fn spread(edge: &MapEdge) -> f64 {
    edge.covariance[(0, 0)] + edge.covariance[(1, 1)]
}

#[cfg(test)]
mod tests;
