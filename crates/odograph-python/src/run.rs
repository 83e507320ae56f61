//! A whole run over a recording.

use crate::camera::{CameraArgument, RigArgument, mount, warn};
use crate::error::{Failure, Result};
use crate::odometry::motion;
use crate::trajectory::PyTrajectory;
use odograph_core::pose_frame::PoseFrame;
use odograph_core::trajectory::FrameEstimate;
use odograph_session::{MapUse, Observer, RunBuilder, RunOutcome, SensorFiles, SourcePlan};
use pyo3::prelude::*;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError, mpsc};
use std::thread;
use std::time::Duration;

/// Follows a recording to its end: a video, a folder of pictures, a robot recording (MCAP, rosbag2,
/// ROS 1 bag), or the run.toml of an earlier run.
///
/// camera is a Camera or the path of a camera file; a robot recording with a camera_info of its
/// images and a map that is continued need none. The mount is height, metres above the ground, or
/// rig, a Rig or the path of a rig file. field_of_view is (width, height) of the ground in the
/// image, metres, in place of both.
///
/// output is the folder for the results (trajectories, map, mosaic, statistics); by default they
/// are in a temporary one, which is removed. map is the file of a map to continue, or to begin.
/// Results that are there are overwritten only if overwrite is true.
///
/// Of the recording: topic with the images, timestamps (a file), fps, start and end (seconds after
/// the first frame), every (n-th frame), max_frames. Other sensors: gyro, compass, wheel,
/// range_finder (CSV files), and gyro_topic, wheel_topic, range_topic of a robot recording. motion
/// as of Odometry; readout is the shutter's, seconds; mask a picture file, black where there is no
/// ground; with loops=False ground that was seen before is not looked for; threads are as many as
/// help, and the results are the same for any number.
///
/// Warnings of the run are Python warnings too. Ctrl-C ends the run: what there is has been
/// written.
#[pyfunction]
#[pyo3(signature = (
    source, camera = None, height = None, *, rig = None, field_of_view = None, output = None, map = None,
    overwrite = false, topic = None, timestamps = None, fps = None, start = None, end = None, every = 1,
    max_frames = None, gyro = None, compass = None, wheel = None, range_finder = None, gyro_topic = None,
    wheel_topic = None, range_topic = None, motion = "auto", readout = None, mask = None, loops = true,
    threads = None
))]
pub fn run(
    py: Python<'_>,
    source: PathBuf,
    camera: Option<CameraArgument<'_>>,
    height: Option<f64>,
    rig: Option<RigArgument<'_>>,
    field_of_view: Option<(f64, f64)>,
    output: Option<PathBuf>,
    map: Option<PathBuf>,
    overwrite: bool,
    topic: Option<String>,
    timestamps: Option<PathBuf>,
    fps: Option<f64>,
    start: Option<f64>,
    end: Option<f64>,
    every: u64,
    max_frames: Option<u64>,
    gyro: Option<PathBuf>,
    compass: Option<PathBuf>,
    wheel: Option<PathBuf>,
    range_finder: Option<PathBuf>,
    gyro_topic: Option<String>,
    wheel_topic: Option<String>,
    range_topic: Option<String>,
    motion: &str,
    readout: Option<f64>,
    mask: Option<PathBuf>,
    loops: bool,
    threads: Option<usize>,
) -> Result<PyTrajectory> {
    if camera.is_some() && field_of_view.is_some() {
        return Err(Failure::usage(
            "camera and field_of_view are both given; a camera has its field of view",
        ));
    }
    let source = source.display().to_string();
    let run = if source.ends_with(".toml") {
        let given = [
            ("camera", camera.is_some()),
            ("height", height.is_some()),
            ("rig", rig.is_some()),
            ("field_of_view", field_of_view.is_some()),
            ("topic", topic.is_some()),
            ("timestamps", timestamps.is_some()),
            ("fps", fps.is_some()),
            ("start", start.is_some()),
            ("end", end.is_some()),
            ("every", every != 1),
            ("max_frames", max_frames.is_some()),
            ("gyro", gyro.is_some()),
            ("compass", compass.is_some()),
            ("wheel", wheel.is_some()),
            ("range_finder", range_finder.is_some()),
            ("gyro_topic", gyro_topic.is_some()),
            ("wheel_topic", wheel_topic.is_some()),
            ("range_topic", range_topic.is_some()),
            ("motion", motion != "auto"),
            ("readout", readout.is_some()),
            ("mask", mask.is_some()),
            ("loops", !loops),
        ];
        if let Some((option, _)) = given.iter().find(|(_, given)| *given) {
            return Err(Failure::usage(format!(
                "{source} already says everything about the run; leave {option} away, or change the file"
            )));
        }
        RunBuilder::repeating(source)
    } else {
        let plan = SourcePlan {
            topic,
            timestamps,
            fps,
            start_s: start,
            end_s: end,
            every,
            max_frames,
            ..SourcePlan::new(source)
        };
        let sensors = SensorFiles {
            gyro,
            heading: compass,
            wheel,
            range: range_finder,
            gyro_topic,
            wheel_topic,
            range_topic,
            ..SensorFiles::default()
        };
        let run = RunBuilder::over(plan).sensors(sensors).motion(self::motion(motion)?);
        let run = camera.iter().fold(run, |run, camera| camera.of_run(run));
        let run = field_of_view
            .iter()
            .fold(run, |run, (width_m, height_m)| run.field_of_view_m(*width_m, *height_m));
        let run = mount(py, height, rig)?.into_iter().fold(run, RunBuilder::rig);
        let run = readout.iter().fold(run, |run, readout_s| run.readout_s(*readout_s));
        let run = mask.iter().fold(run, RunBuilder::mask);
        if loops { run } else { run.without_loops() }
    };
    let run = run.overwriting(overwrite);
    let run = output.iter().fold(run, RunBuilder::folder);
    let run = map.into_iter().fold(run, |run, map| run.map(MapUse::Continue(map)));
    let run = threads.into_iter().fold(run, RunBuilder::threads);
    let (outcome, frames) = followed(py, &run)?;
    outcome.warnings.iter().try_for_each(|warning| warn(py, warning))?;
    PyTrajectory::new(frames, outcome, output.is_some())
}

/// Hears of a run, and asks it to end.
#[derive(Default)]
struct Watching {
    stops: AtomicBool,
    frames: Mutex<Vec<(FrameEstimate, PoseFrame)>>,
    warnings: Mutex<Vec<String>>,
}

impl Observer for Watching {
    fn final_frame(&self, estimate: &FrameEstimate, of: &PoseFrame) {
        self.frames.lock().unwrap_or_else(PoisonError::into_inner).push((estimate.clone(), *of));
    }

    fn warn(&self, sentence: &str) {
        self.warnings.lock().unwrap_or_else(PoisonError::into_inner).push(sentence.to_owned());
    }

    fn is_stop_asked(&self) -> bool {
        self.stops.load(Ordering::Relaxed)
    }
}

/// How long Ctrl-C may wait to be heard.
const EVERY: Duration = Duration::from_millis(50);

/// Follows a run detached from the interpreter, in a thread of its own so that this one can hear
/// signals, and returns its final frames too.
pub fn followed(py: Python<'_>, run: &RunBuilder) -> Result<(RunOutcome, Vec<(FrameEstimate, PoseFrame)>)> {
    let watching = Watching::default();
    let (outcome, signal) = py.detach(|| {
        thread::scope(|scope| {
            let (done, ended) = mpsc::channel::<()>();
            let following = scope.spawn(|| {
                // Dropped when the run has ended, however it does.
                let _done = done;
                run.run(&watching)
            });
            let mut signal = None;
            while ended.recv_timeout(EVERY) == Err(mpsc::RecvTimeoutError::Timeout) {
                if signal.is_none()
                    && let Err(error) = Python::attach(|py| py.check_signals())
                {
                    signal = Some(error);
                    watching.stops.store(true, Ordering::Relaxed);
                }
            }
            (following.join(), signal)
        })
    });
    let outcome = outcome.unwrap_or_else(|panic| std::panic::resume_unwind(panic));
    match signal {
        Some(signal) => return Err(signal.into()),
        None => watching
            .warnings
            .into_inner()
            .unwrap_or_else(PoisonError::into_inner)
            .iter()
            .try_for_each(|warning| warn(py, warning))?,
    }
    Ok((outcome?, watching.frames.into_inner().unwrap_or_else(PoisonError::into_inner)))
}
