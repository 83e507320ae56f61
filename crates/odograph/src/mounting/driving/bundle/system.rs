//! The normal equations of one pair.

use super::lens::LensUnknowns;
use super::pair::{Movement, SolvedPair};
use super::{LENS_START, TILT};
use crate::geometry::GroundPose;
use crate::mounting::driving::PairedTrack;
use crate::numerics::{Part, inverse};
use nalgebra::{Matrix6, SMatrix, SVector, Vector2};

/// Normal equations of one pair, divided by its noise variance: common unknowns first, then its
/// motion.
pub struct System<const N: usize> {
    common: SMatrix<f64, N, N>,
    cross: SMatrix<f64, N, 6>,
    pub movement: Matrix6<f64>,
    common_slope: SVector<f64, N>,
    movement_slope: Movement,
}

impl<const N: usize> System<N> {
    pub fn new(
        lens: &LensUnknowns,
        solved: &SolvedPair<'_>,
        rig: &GroundPose,
        pair_variance: &[f64; 3],
    ) -> Self {
        let views = solved.views(lens.camera(), rig);
        let mut system = Self {
            common: SMatrix::zeros(),
            cross: SMatrix::zeros(),
            movement: Matrix6::zeros(),
            common_slope: SVector::zeros(),
            movement_slope: Movement::zeros(),
        };
        let tracks = solved.pair.tracks.iter().zip(&solved.corners).zip(&solved.weights);
        for ((track, corner), &weight) in tracks {
            let PairedTrack { first: corner_at, second: seen_at, whitening, .. } = track;
            let Some(corner) = corner.as_ref().filter(|_| weight > 0.0) else { continue };
            let (first, second) = (views.posed(0, corner_at.y), views.posed(1, seen_at.y));
            let Some(met) = first.ground(corner.ray) else { continue };
            let Some(seen) = second.see(met.point) else { continue };
            let Some(pixel_by_lens) = lens.pixel_by_lens(seen.ray) else { continue };
            let weight = weight / solved.variance_px2;
            let error = whitening * Vector2::new(seen_at.x - seen.pixel.x, seen_at.y - seen.pixel.y);
            let by_movement = whitening * seen.by_pose;
            let by_tilt =
                seen.by_pose.fixed_columns::<TILT>(4) + seen.by_ground * met.by_pose.fixed_columns::<TILT>(4);
            let mut by_common = SMatrix::<f64, 2, N>::zeros();
            by_common.fixed_columns_mut::<TILT>(0).copy_from(&by_tilt);
            for k in LENS_START..N {
                let ray_by_lens = corner.by_lens[k - LENS_START];
                let by_lens = pixel_by_lens[k - LENS_START] + seen.by_ground * (met.by_ray * ray_by_lens);
                by_common.set_column(k, &by_lens);
            }
            let by_common = whitening * by_common;
            system.common += weight * by_common.transpose() * by_common;
            system.cross += weight * by_common.transpose() * by_movement;
            system.movement += weight * by_movement.transpose() * by_movement;
            system.common_slope += weight * by_common.transpose() * error;
            system.movement_slope += weight * by_movement.transpose() * error;
        }
        for (k, variance) in pair_variance.iter().enumerate() {
            system.movement[(3 + k, 3 + k)] += 1.0 / variance;
            system.movement_slope[3 + k] -= solved.movement[3 + k] / variance;
        }
        system
    }

    /// Schur complement: equations of the common unknowns with the motion marginalised.
    pub fn reduced(&self) -> Option<Part<N>> {
        let movement = inverse(&self.movement)?;
        Some(Part {
            information: self.common - self.cross * movement * self.cross.transpose(),
            slope: self.common_slope - self.cross * movement * self.movement_slope,
        })
    }

    /// Back substitution: the step of the motion for a step of the common unknowns.
    pub fn movement_step(&self, step: &SVector<f64, N>) -> Option<Movement> {
        Some(inverse(&self.movement)? * (self.movement_slope - self.cross.transpose() * step))
    }
}
