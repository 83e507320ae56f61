//! The sparse normal equations: a block for each keyframe, in a fill-reducing order.
//!
//! The order is approximate minimum degree (P. Amestoy, T. Davis and I. Duff, 1996) on the graph of
//! the keyframes. One more block holds the two unknowns of the mount; it is connected to nearly all
//! keyframes and so comes last. With absolute edges the logarithm of the placement's scale is its
//! third unknown, and another block holds the placement's position and direction.

use super::absolute::LinearizedPoint;
use super::edge::{Linearized, Weighted};
use super::marginals;
use crate::geometry::pose_index::HEADING;
use nalgebra::{DVector, Matrix4, Vector2, Vector4};
use nalgebra_sparse::factorization::CscCholesky;
use nalgebra_sparse::{CscMatrix, pattern::SparsityPattern};

pub struct GraphNormalEquations {
    /// Unknowns per block: 3 or 4.
    size: usize,
    /// Number of blocks of keyframes.
    count: usize,
    /// For each node of the graph, its block; `None` if it is fixed.
    block_of: Vec<Option<usize>>,
    /// For each block, its place in the order.
    place: Vec<usize>,
    /// For each place, the places it is connected to, including itself, ascending.
    tied: Vec<Vec<usize>>,
    /// For each place, the offset of its values.
    base: Vec<usize>,
    matrix: CscMatrix<f64>,
    factor: Option<CscCholesky<f64>>,
    right: DVector<f64>,
}

impl GraphNormalEquations {
    /// The pattern for `count` blocks and their connections; a connection has its two ends (`None`
    /// if fixed) and whether it depends on the mount. `points` are the blocks with absolute edges,
    /// if there are any. `None` if no order is found, which cannot happen for well-formed
    /// connections.
    pub fn new(
        size: usize,
        count: usize,
        ties: impl Iterator<Item = (Option<usize>, Option<usize>, bool)>,
        points: Option<&[Option<usize>]>,
        block_of: Vec<Option<usize>>,
    ) -> Option<Self> {
        let (mount, placement) = (count, count + 1);
        let blocks = count + 1 + usize::from(points.is_some());
        let mut tied: Vec<Vec<usize>> = (0..blocks).map(|block| vec![block]).collect();
        let mut tie = |a: usize, b: usize| {
            tied[a].push(b);
            tied[b].push(a);
        };
        for (from, to, bends) in ties {
            if let (Some(from), Some(to)) = (from, to) {
                tie(from, to);
            }
            for end in [from, to].into_iter().flatten().filter(|_| bends) {
                tie(end, mount);
            }
        }
        if let Some(points) = points {
            tie(mount, placement);
            for &block in points.iter().flatten() {
                tie(block, mount);
                tie(block, placement);
            }
        }
        for others in &mut tied {
            others.sort_unstable();
            others.dedup();
        }
        let order = order(&tied)?;
        let mut place = vec![0; order.len()];
        order.iter().enumerate().for_each(|(at, &block)| place[block] = at);
        let tied: Vec<Vec<usize>> = order
            .iter()
            .map(|&block| {
                let mut places: Vec<usize> = tied[block].iter().map(|&other| place[other]).collect();
                places.sort_unstable();
                places
            })
            .collect();
        let (mut base, mut offsets, mut rows) = (Vec::new(), vec![0], Vec::new());
        for places in &tied {
            base.push(rows.len());
            for _ in 0..size {
                rows.extend(places.iter().flat_map(|&at| (0..size).map(move |i| at * size + i)));
                offsets.push(rows.len());
            }
        }
        let unknowns = size * tied.len();
        let pattern =
            SparsityPattern::try_from_offsets_and_indices(unknowns, unknowns, offsets, rows).ok()?;
        let values = vec![0.0; pattern.nnz()];
        let matrix = CscMatrix::try_from_pattern_and_values(pattern, values).ok()?;
        Some(Self {
            size,
            count,
            block_of,
            place,
            tied,
            base,
            matrix,
            factor: None,
            right: DVector::zeros(unknowns),
        })
    }

    /// Number of free keyframes.
    pub fn unknowns(&self) -> usize {
        self.count
    }

    /// The index of a node's marginal; `None` if it is fixed.
    pub fn block_of(&self, node: usize) -> Option<usize> {
        self.block_of[node]
    }

    fn mount(&self) -> usize {
        self.place[self.count]
    }

    /// `None` without absolute edges.
    fn placement(&self) -> Option<usize> {
        self.place.get(self.count + 1).copied()
    }

    pub fn clear(&mut self) {
        self.matrix.values_mut().fill(0.0);
        self.right.fill(0.0);
    }

    /// Adds an edge with a weight, and whether it depends on the mount.
    pub fn add(&mut self, edge: &Weighted, linear: &Linearized, weight: f64, with_mount: bool) {
        let mut by_mount = Matrix4::zeros();
        by_mount.fixed_view_mut::<4, 2>(0, 0).copy_from(&linear.by_mount);
        let ends = [
            self.block_of[edge.from].map(|block| (self.place[block], linear.by_from)),
            self.block_of[edge.to].map(|block| (self.place[block], linear.by_to)),
            with_mount.then_some((self.mount(), by_mount)),
        ];
        self.add_residual(&ends, &linear.misses, weight);
    }

    /// Adds an absolute edge of a node with a weight.
    pub fn add_point(&mut self, node: usize, linear: &LinearizedPoint, weight: f64) {
        let ends = [
            self.block_of[node].map(|block| (self.place[block], linear.by_node)),
            Some((self.mount(), linear.by_scale)),
            self.placement().map(|placement| (placement, linear.by_placement)),
        ];
        self.add_residual(&ends, &linear.misses, weight);
    }

    /// Adds a residual with its Jacobians with respect to the blocks at these places.
    fn add_residual(
        &mut self,
        ends: &[Option<(usize, Matrix4<f64>)>; 3],
        misses: &Vector4<f64>,
        weight: f64,
    ) {
        for (a, by_a) in ends.iter().flatten() {
            let push = by_a.transpose() * misses * weight;
            for i in 0..self.size {
                self.right[a * self.size + i] -= push[i];
            }
            for (b, by_b) in ends.iter().flatten() {
                self.add_block(*a, *b, &(by_a.transpose() * by_b * weight));
            }
        }
    }

    /// Adds to the block in row `a` and column `b`.
    fn add_block(&mut self, a: usize, b: usize, block: &Matrix4<f64>) {
        let Ok(at) = self.tied[b].binary_search(&a) else { return };
        let (size, height) = (self.size, self.size * self.tied[b].len());
        let base = self.base[b] + at * size;
        let values = self.matrix.values_mut();
        for column in 0..size {
            for row in 0..size {
                values[base + column * height + row] += block[(row, column)];
            }
        }
    }

    /// The prior of the mount; the unused unknown of its block is fixed.
    pub fn hold_mount(&mut self, turn_per_m: Vector2<f64>, sigma: f64) {
        let weight = 1.0 / (sigma * sigma);
        let mount = self.mount();
        let mut block = Matrix4::identity();
        (block[(0, 0)], block[(1, 1)]) = (weight, weight);
        self.add_block(mount, mount, &block);
        for i in 0..2 {
            self.right[mount * self.size + i] -= weight * turn_per_m[i];
        }
    }

    /// The prior of the placement's ln scale, and whether the rest of the placement is known.
    pub fn hold_placement(&mut self, ln_scale: f64, sigma: f64, is_known: bool) {
        let Some(placement) = self.placement() else { return };
        let (weight, mount) = (1.0 / (sigma * sigma), self.mount());
        let mut block = Matrix4::zeros();
        block[(SCALE, SCALE)] = weight - 1.0; // in place of the 1 of an unused unknown
        self.add_block(mount, mount, &block);
        self.right[mount * self.size + SCALE] -= weight * ln_scale;
        let mut block = Matrix4::zeros();
        block[(3, 3)] = 1.0; // unused
        if is_known {
            block.fill_diagonal(KNOWN);
        }
        self.add_block(placement, placement, &block);
    }

    /// The Levenberg–Marquardt step with the diagonal raised by the factor `1 + damping`; `None` if
    /// the matrix is not positive definite.
    pub fn solve(&mut self, damping: f64) -> Option<DVector<f64>> {
        self.factorize(damping)?;
        let mut change = self.right.clone();
        self.factor.as_ref()?.solve_mut(&mut change);
        change.iter().all(|value| value.is_finite()).then_some(change)
    }

    /// The expected reduction of the squared residuals by a step.
    pub fn explained(&self, change: &DVector<f64>) -> f64 {
        self.right.dot(change)
    }

    fn factorize(&mut self, damping: f64) -> Option<()> {
        let mut values = self.matrix.values().to_vec();
        if damping > 0.0 {
            for (place, tied) in self.tied.iter().enumerate() {
                let Ok(at) = tied.binary_search(&place) else { continue };
                let height = self.size * tied.len();
                for i in 0..self.size {
                    values[self.base[place] + i * height + at * self.size + i] *= 1.0 + damping;
                }
            }
        }
        match &mut self.factor {
            Some(factor) => factor.refactor(&values).ok(),
            None => {
                let pattern = self.matrix.pattern().clone();
                let matrix = CscMatrix::try_from_pattern_and_values(pattern, values).ok()?;
                self.factor = Some(CscCholesky::factor(&matrix).ok()?);
                Some(())
            }
        }
    }

    /// A node's part of a solution; `None` if it is fixed.
    pub fn of_node(&self, solution: &DVector<f64>, node: usize) -> Option<Vector4<f64>> {
        let first = self.size * self.place[self.block_of[node]?];
        Some(Vector4::from_fn(|i, _| if i < self.size { solution[first + i] } else { 0.0 }))
    }

    /// The mount's part of a solution.
    pub fn of_mount(&self, solution: &DVector<f64>) -> Vector2<f64> {
        let first = self.size * self.mount();
        Vector2::new(solution[first], solution[first + 1])
    }

    /// The placement's part of a solution: x, y, heading and ln scale; `None` without absolute
    /// edges.
    pub fn of_placement(&self, solution: &DVector<f64>) -> Option<Vector4<f64>> {
        let first = self.size * self.placement()?;
        let scale = solution[self.size * self.mount() + SCALE];
        Some(Vector4::new(solution[first], solution[first + 1], solution[first + 2], scale))
    }

    /// Variances of the placement; `None` without absolute edges.
    pub fn placement_variances(&mut self) -> Option<PlacementVariances> {
        self.factorize(0.0)?;
        let inverse = marginals::on_pattern(self.factor.as_ref()?.l());
        let at = |unknown: usize| inverse.get(unknown, unknown);
        let heading = at(self.size * self.placement()? + HEADING);
        Some(PlacementVariances { heading, ln_scale: at(self.size * self.mount() + SCALE) })
    }

    /// The diagonal blocks of the inverse, block by block.
    pub fn marginals(&mut self) -> Option<Vec<Matrix4<f64>>> {
        self.factorize(0.0)?;
        let inverse = marginals::on_pattern(self.factor.as_ref()?.l());
        let block = |block: usize| {
            let first = self.size * self.place[block];
            Matrix4::from_fn(|i, j| {
                if i < self.size && j < self.size {
                    inverse.get(first + i.max(j), first + i.min(j))
                } else {
                    0.0
                }
            })
        };
        Some((0..self.unknowns()).map(block).collect())
    }
}

/// Variances of two numbers of the placement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlacementVariances {
    /// Square radians.
    pub heading: f64,
    pub ln_scale: f64,
}

/// Index of the logarithm of the placement's scale in the block of the mount.
const SCALE: usize = 2;

/// Information of a quantity that is known exactly: a standard deviation of 1e-9.
const KNOWN: f64 = 1e18;

/// The elimination order of the blocks.
fn order(tied: &[Vec<usize>]) -> Option<Vec<usize>> {
    let mut offsets = vec![0isize];
    let mut rows = Vec::new();
    for others in tied {
        rows.extend(others.iter().map(|&other| other as isize));
        offsets.push(rows.len() as isize);
    }
    let (order, _, _) = amd::order(tied.len() as isize, &offsets, &rows, &amd::Control::default()).ok()?;
    Some(order.into_iter().map(|block| block as usize).collect())
}
