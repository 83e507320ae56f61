//! Clips rendered from the rows.

use crate::clip::Clip;
use crate::compression;
use crate::rows::{BenchmarkRow, camera, careless};
use odograph::camera::Rig;
use odograph::error::{Error, Result};
use odograph::trajectory::{StampedPose, Trajectory};
use odograph_simulation::{Path, Simulation, SimulationConfig, Texture};

/// Renders a row with a seed.
pub fn render(row: &BenchmarkRow, seed: u64) -> Result<Clip> {
    let texture = Texture::named(row.texture)
        .ok_or_else(|| Error::usage(format!("{}: no texture is called {}", row.name, row.texture)))?;
    let simulation = Simulation::new(SimulationConfig {
        camera: camera(row.size_px)?,
        rig: row.rig,
        texture,
        path: Path::new((row.path)(seed), row.speed_m_s, row.turn_rate_rad_s, true)?,
        effects: row.effects.clone(),
        fps: row.fps,
        duration_s: None,
        colored: false,
        seed: 1000 + seed,
    })?;
    let readout_s = row.readout_is_given.then_some(row.effects.readout_s);
    let given = camera(row.size_px)?.with_readout_s(readout_s)?;
    let mut clip = Clip {
        camera: if row.lens_is_careless { careless(&given)? } else { given },
        rig: row.given_rig,
        frames: Vec::with_capacity(simulation.len()),
        truth: Trajectory::default(),
        fps: row.fps,
    };
    for frame in simulation.frames() {
        let world_from_camera = frame.truth.world_from_camera();
        clip.truth.poses.push(StampedPose { time_s: frame.time_s, world_from_camera });
        clip.frames.push((frame.time_s, frame.image));
    }
    if row.effects.terrain.ride {
        level_at_first(&mut clip.truth, &row.rig);
    }
    if let Some(alteration) = row.alteration {
        alteration.apply(&mut clip, seed);
    }
    if let Some(qp) = row.h264_qp {
        compression::compress(&mut clip, qp)?;
    }
    Ok(clip)
}

/// Turns the world of a camera that rides on a slope at first, so that it stands over the plane
/// z = 0 as its mount says: that is the world of a trajectory.
fn level_at_first(truth: &mut Trajectory, rig: &Rig) {
    let Some(first) = truth.poses.first() else { return };
    let levelled = rig.first_pose().world_from_camera() * first.world_from_camera.inverse();
    for pose in &mut truth.poses {
        pose.world_from_camera = levelled * pose.world_from_camera;
    }
}
