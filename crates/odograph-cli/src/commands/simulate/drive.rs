//! A drive over a floor: its frames, and the files that belong to them.

use super::output::{Picture, Recording, SimulationOutput, Texts};
use super::{FormatName, SimulateArguments, scene, without_effect};
use crate::{Outcome, console};
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::filter::fusion::Sensors;
use odograph::formats::trajectory_file::write_tum;
use odograph::formats::{camera_file, control_file, rig_file, sensor_file};
use odograph::trajectory::{StampedPose, Trajectory};
use odograph_simulation::Simulation;
use std::fmt::Write as _;
use std::path::Path;

impl Recording for Simulation {
    fn video_name(&self) -> &'static str {
        "sim"
    }

    fn camera(&self) -> &Camera {
        &self.config().camera
    }

    fn fps(&self) -> f64 {
        self.config().fps
    }

    fn colored(&self) -> bool {
        self.config().colored
    }

    fn times_s(&self) -> &[f64] {
        self.times_s()
    }

    fn frame(&self, number: usize) -> Option<Picture> {
        let frame = self.frame(number)?;
        Some(Picture { gray: frame.image, color: frame.color })
    }
}

/// Renders a drive.
pub fn simulate(arguments: &SimulateArguments) -> Result<Outcome> {
    without_effect::check(arguments)?;
    let (config, parameters) = scene::from_arguments(arguments)?;
    let simulation = Simulation::new(config)?;
    let simulation = match &arguments.markers {
        Some(markers) => simulation.with_markers(&markers.family, markers.spacing_m)?,
        None => simulation,
    };
    if !arguments.quiet {
        arguments.height.question();
    }
    let sensors = if arguments.sensors { Some(simulation.sensors()?) } else { None };
    let parameters = match &sensors {
        Some(sensors) => parameters.with_sensors(sensors),
        None => parameters,
    };
    let format = arguments.format.unwrap_or(FormatName::Png);
    let timing = simulation.config().effects.timing;
    if format != FormatName::Png && (timing.dropped > 0.0 || timing.jitter_s > 0.0) {
        return Err(Error::usage(
            "frames that are dropped or late need timestamps, which only --format png keeps (frames.txt)",
        ));
    }
    let output = SimulationOutput::prepared(arguments, format, simulation.len())?;
    output.write(&simulation, || {
        let records = sensors.map_or_else(Sensors::default, |sensors| sensors.records);
        let mut texts = texts(&simulation, arguments.tell_readout);
        texts.push(("simulation.toml", parameters.as_toml()?));
        let records = [
            ("gyro.csv", records.gyro),
            ("heading.csv", records.heading),
            ("wheel.csv", records.wheel),
            ("range.csv", records.range),
        ];
        texts.extend(
            records.into_iter().filter_map(|(name, record)| Some((name, sensor_file::write(&record?)))),
        );
        Ok(texts)
    })?;
    if !arguments.quiet {
        print_result(output.folder(), &simulation)?;
    }
    Ok(Outcome::Done)
}

/// The truth, the camera, its mount, and markers, if there are any.
fn texts(simulation: &Simulation, tell_readout: bool) -> Texts {
    let config = simulation.config();
    let poses = simulation.times_s().iter().map(|&time_s| StampedPose {
        time_s,
        world_from_camera: simulation.truth(time_s).world_from_camera(),
    });
    let mut camera = camera_file::write(&config.camera);
    if tell_readout {
        let _ = writeln!(camera, "readout_time_s: {}", config.effects.readout_s);
    }
    let mut texts = vec![
        ("truth.tum", write_tum(&Trajectory { poses: poses.collect() })),
        ("camera.yaml", camera),
        ("rig.toml", rig_file::write(&config.rig)),
    ];
    if !simulation.markers().is_empty() {
        texts.push(("markers.csv", control_file::write(simulation.markers())));
    }
    texts
}

fn print_result(folder: &Path, simulation: &Simulation) -> Result<()> {
    let last_s = simulation.times_s().last().copied().unwrap_or(0.0);
    console::print(&format!(
        "{}: {} frames, {last_s:.2} s, {:.2} m of path; truth.tum, camera.yaml and rig.toml lie beside them\n",
        console::name(folder),
        simulation.len(),
        simulation.config().path.length_m(),
    ))
}
