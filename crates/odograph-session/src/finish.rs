//! The end of a run: smoothing, sensor fusion and loop correction, output files and drawings.
//! Trajectories are written first, because they cannot be recovered without the recording. Later
//! failures are reported at the end, after everything else is written.

use crate::budget::Budget;
use crate::earth::{self, GnssRecord, OnEarth};
use crate::earth_statistics::GnssStatistics;
use crate::folder::OutputFolder;
use crate::found::{FoundLens, FoundReadout};
use crate::kept_frames::KeptFrames;
use crate::marker_statistics::MarkerStatistics;
use crate::observer::Observer;
use crate::outcome::{RunEnd, RunOutcome};
use crate::output::RunOutput;
use crate::pipeline::Tracked;
use crate::place::PlaceInMap;
use crate::plan::RunPlan;
use crate::report::RunReporter;
use crate::resemblance::Resemblance;
use crate::ros_bag::RosBagWriter;
use crate::statistics::{
    BudgetStatistics, LoopStatistics, RunStatistics, SensorStatistics, interruption, peak_memory_bytes,
};
use crate::timings::StageTime;
use crate::{files, pictures, reference, tilt};
use odograph::error::{Error, Result};
use odograph::filter::fusion::{Reckoned, SensorReport, Sensors};
use odograph::filter::{Carrier, SmoothedFrame, SmoothedPath, Smoother, fusion};
use odograph::formats::camera_file;
use odograph::formats::trajectory_file::{SMOOTHED_HEADER, smoothed_line};
use odograph::mosaic::Mosaic;
use odograph::pose_frame::{PoseFrame, PoseFrames};
use odograph::slam::Bent;
use odograph::trajectory::{FrameSummary, TrackStatus, distance_m};
use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};

/// Inputs for finishing a run.
pub struct Ending<'a> {
    /// Description of the recording.
    pub description: &'a str,
    pub sensors: &'a Sensors,
    /// Positions by a satellite receiver.
    pub gnss: Option<&'a GnssRecord>,
    pub output: &'a RunOutput,
    pub reporter: Option<&'a dyn RunReporter>,
    pub observer: &'a dyn Observer,
    /// When the run began.
    pub started: Instant,
}

/// Improves the trajectory and writes everything into the folder.
pub fn finish(
    plan: &RunPlan,
    mut tracked: Tracked,
    folder: &mut OutputFolder,
    ending: &Ending<'_>,
) -> Result<RunOutcome> {
    enough(plan, &mut tracked, ending.output)?;
    let mut of = PoseFrames::from(plan.pose_frame()?);
    tracked.recalibrated.iter().for_each(|(frame, rig)| of.recalibrate(*frame, rig));
    let failure = ended_early(&mut tracked);
    let mut run = Finishing { failure, plan, of: of.clone(), tracked, folder, ending };
    run.report_calibration()?;
    let mut improved = run.improve(ending.sensors)?;
    run.write_paths(&mut improved)?;
    improved.observe(&mut run.tracked, &of, ending.observer)?;
    let frames = improved.summaries(&mut run.tracked, &of)?;
    let place = run.place_in_map(&mut improved)?;
    let on_earth = run.place_on_earth(&mut improved, &frames)?;
    let Improved { mut corrected, sensors, loops, markers, .. } = improved;
    run.draw(corrected.as_mut(), &frames, &sensors, markers.as_ref(), on_earth.as_ref())?;
    let estimated = Estimated { loops, markers, gnss: on_earth.map(|on_earth| on_earth.statistics) };
    run.end(frames, place, &sensors, estimated)
}

/// The camera file with the estimated lens, where it differs from the plan.
const FOUND_CAMERA: &str = "camera-found.yaml";

/// The mask of what is static in the image.
const MASK: &str = "mask.png";

/// A run that is being finished.
struct Finishing<'a> {
    plan: &'a RunPlan,
    /// The frame whose poses are written and shown.
    of: PoseFrames,
    /// Frames of the camera in the odometry frame.
    tracked: Tracked,
    folder: &'a mut OutputFolder,
    ending: &'a Ending<'a>,
    /// The error that ended the recording early, or the first that prevented an output.
    failure: Option<Error>,
}

/// The frames after sensor fusion and loop closure.
struct Improved {
    /// The final frames; `None` if they equal the odometry's.
    corrected: Option<KeptFrames>,
    /// Frames without a measured pose, as dead-reckoned from the sensors.
    reckoned: Reckoned,
    sensors: Vec<SensorReport>,
    loops: LoopStatistics,
    markers: Option<MarkerStatistics>,
    /// What a satellite receiver changed of the map.
    bent: Option<Bent>,
}

/// What the loops, the markers and the satellite receiver said of the path.
struct Estimated {
    loops: LoopStatistics,
    markers: Option<MarkerStatistics>,
    gnss: Option<GnssStatistics>,
}

/// What a person is told about interlaced video.
const INTERLACED: &str = "the video is interlaced: even and odd rows of a frame are of different times, and the even ones \
                          alone are used; a camera set to progressive video gives twice as many rows";

impl Improved {
    /// Gives the final frames as poses of `of` to the observer.
    fn observe(&mut self, tracked: &mut Tracked, of: &PoseFrames, observer: &dyn Observer) -> Result<()> {
        let frames = self.corrected.as_mut().unwrap_or(&mut tracked.frames);
        frames.each(|frame, _| {
            observer.final_frame(&of.frame(frame));
            Ok(())
        })
    }

    /// Their summaries as the path of `of`, for drawings.
    fn summaries(&mut self, tracked: &mut Tracked, of: &PoseFrames) -> Result<Vec<FrameSummary>> {
        let frames = self.corrected.as_mut().unwrap_or(&mut tracked.frames);
        let mut summaries = Vec::with_capacity(frames.count());
        frames.each(|frame, _| {
            summaries.push(FrameSummary::from(&*of.frame(frame)));
            Ok(())
        })?;
        Ok(summaries)
    }
}

/// Fails if there are too few frames for a trajectory.
fn enough(plan: &RunPlan, tracked: &mut Tracked, output: &RunOutput) -> Result<()> {
    if tracked.frames.count() >= output.least_frames || tracked.interrupted {
        return Ok(());
    }
    let too_few = if tracked.frames.count() == 0 { "no frame" } else { "only one frame" };
    Err(tracked.failure.take().unwrap_or_else(|| {
        Error::input(format!(
            "{} has {too_few} in the chosen range; a movement needs at least two",
            plan.source.path
        ))
    }))
}

/// The errors that ended the recording or its map early, each with a warning.
fn ended_early(tracked: &mut Tracked) -> Option<Error> {
    let recording = tracked.failure.take();
    tracked.warnings.extend(recording.as_ref().map(|error| format!("the recording ended early: {error}")));
    let map = tracked.unmapped.take();
    tracked.warnings.extend(map.as_ref().map(|error| format!("the map ended early: {error}")));
    recording.or(map)
}

impl Finishing<'_> {
    fn warn(&mut self, warning: impl IntoIterator<Item = String>) {
        self.tracked.warnings.extend(warning);
    }

    /// An output other than the trajectories failed: the run continues and fails at the end.
    fn fail(&mut self, what: &str, error: Error) {
        self.warn([format!("{what}: {error}")]);
        self.failure.get_or_insert(error);
    }

    /// Warns where the estimated mount, lens or readout time differs from the plan.
    fn report_calibration(&mut self) -> Result<()> {
        let warning = match &self.tracked.mount {
            Some(found) if self.tracked.live.is_some() => Some(found.live_sentence()),
            Some(found) => Some(found.sentence()),
            None => tilt::mount_warning(
                &mut self.tracked.frames,
                &self.plan.rig,
                self.plan.odometry.motion.model,
            )?,
        };
        self.warn(warning);
        let bends = self.tracked.lens.as_ref().map(FoundLens::sentence);
        self.warn(bends);
        let reads = self.tracked.readout.as_ref().and_then(FoundReadout::sentence);
        self.warn(reads);
        let combed = self.tracked.interlaced.then(|| INTERLACED.to_owned());
        self.warn(combed);
        Ok(())
    }

    /// Fuses other sensors first; loop closures then correct the fused path.
    fn improve(&mut self, sensors: &Sensors) -> Result<Improved> {
        let tracked = &mut self.tracked;
        let (mut fused, mut reckoned, mut reports) = (None, Reckoned::default(), Vec::new());
        if *sensors != Sensors::default() {
            // Sensor fusion needs the whole recording in memory; no other step does.
            let (raw, mut references) = tracked.frames.all()?;
            let fusion = fusion::fuse(&raw, sensors);
            if fusion.moved {
                tracked.mapping.take_over(&raw, &fusion.frames, &mut references);
                let mut kept = KeptFrames::new(self.folder.path());
                fusion.frames.into_iter().zip(references).for_each(|(f, reference)| kept.push(f, reference));
                fused = Some(kept);
            }
            (reckoned, reports) = (fusion.reckoned, fusion.reports);
        }
        let frames = fused.as_mut().unwrap_or(&mut tracked.frames);
        tracked.mapping.finish();
        let (moves, folder) = (!reckoned.is_empty(), self.folder.path());
        let mut straight = tracked.mapping.straighten(frames, moves, folder)?;
        let mut bent = None;
        if let Some(gnss) = self.ending.gnss {
            let mut carrier = PoseFrames::of_carrier(&self.plan.rig);
            tracked.recalibrated.iter().for_each(|(frame, rig)| carrier.recalibrate(*frame, rig));
            let antenna = self.plan.antenna.as_ref();
            let measured = earth::measured_path(frames, &carrier, antenna)?;
            let path =
                earth::antenna_path(straight.frames.as_mut().unwrap_or(&mut *frames), &carrier, antenna)?;
            bent = gnss
                .antenna_fixes(&path, &measured)
                .and_then(|(fixes, found)| tracked.mapping.bend_to(&fixes, &found));
            if bent.is_some() {
                straight = tracked.mapping.straighten(frames, moves, folder)?;
            }
        }
        let reckoned = reckoned.moved_with(&straight.moves);
        let loops = tracked.mapping.statistics(&straight);
        tracked.warnings.extend(tracked.mapping.warning());
        tracked.warnings.extend(self.plan.sensors.warnings(&reports));
        let markers = tracked.mapping.marker_statistics().map(|(statistics, warnings)| {
            tracked.warnings.extend(warnings);
            statistics
        });
        Ok(Improved {
            corrected: straight.frames.or(fused),
            reckoned,
            sensors: reports,
            loops,
            markers,
            bent,
        })
    }

    /// Writes the trajectories, the map's keyframes, and the paths derived from the frames.
    fn write_paths(&mut self, improved: &mut Improved) -> Result<()> {
        let frames = improved.corrected.as_mut().unwrap_or(&mut self.tracked.frames);
        let text = self.plan.text_in(self.folder.path())?;
        self.folder.write_trajectories(frames, &self.of, &text)?;
        let camera = camera_file::write(&self.plan.camera);
        // The camera file of an earlier run may be the input of this one; it is kept.
        let stays = self.folder.holds(FOUND_CAMERA, camera.as_bytes());
        match self.tracked.lens {
            Some(_) => self.folder.write(FOUND_CAMERA, camera.as_bytes())?,
            None if stays => {}
            None => self.folder.remove(FOUND_CAMERA)?,
        }
        if self.tracked.fixed.share > 0.0 {
            self.folder.write(MASK, &files::png_from_gray(&self.tracked.fixed.picture)?)?;
        } else {
            self.folder.remove(MASK)?;
        }
        let of = &self.of;
        self.folder.write_tum("odometry.tum", of.last(), |put| {
            self.tracked.frames.each(|frame, _| of.stamped(frame).as_ref().map_or(Ok(()), &mut *put))
        })?;
        // The map comes after the trajectories because it may not fit on the disk; later outputs
        // are written even then.
        let frames = improved.corrected.as_mut().unwrap_or(&mut self.tracked.frames);
        if let Err(error) = self.tracked.mapping.save(frames) {
            self.fail("the map is not where the trajectories are", error);
        }
        self.write_smoothed(improved)?;
        if let Some(bag) = &self.ending.output.bag
            && let Err(error) = self.write_bag(bag, improved)
        {
            self.fail("there is no bag", error);
        }
        Ok(())
    }

    /// The bag of ROS 2: frames as odometry had them, and where they finally are.
    fn write_bag(&mut self, path: &Path, improved: &mut Improved) -> Result<()> {
        let mut in_map = Vec::new();
        if let Some(corrected) = &mut improved.corrected {
            in_map.reserve_exact(corrected.count());
            corrected.each(|frame, _| {
                in_map.push(frame.estimate.as_ref().map(|known| known.pose));
                Ok(())
            })?;
        }
        let mut in_map = in_map.into_iter();
        files::write_with(path, |output| {
            let mut bag = RosBagWriter::new(path, output, self.of.clone())?;
            self.tracked.frames.each(|frame, _| bag.add(frame, in_map.next().flatten().as_ref()))?;
            bag.finish()
        })?;
        self.folder.is_written(path.to_owned());
        Ok(())
    }

    /// Computes the smoothed path and the carrier's path from a few numbers per frame, and writes
    /// them frame by frame.
    fn write_smoothed(&mut self, improved: &mut Improved) -> Result<()> {
        let frames = improved.corrected.as_mut().unwrap_or(&mut self.tracked.frames);
        let mut smoother = Smoother::for_frames(frames.count());
        frames.each(|frame, _| {
            smoother.push(frame);
            Ok(())
        })?;
        let path = smoother.smoothed(&self.plan.odometry.filter);
        let of = &self.of;
        let mut smoothed = FrameSmoother { frames, path: &path, reckoned: &improved.reckoned };
        self.folder.write_lines("trajectory-smoothed.csv", SMOOTHED_HEADER, |put| {
            smoothed.each(|frame| put(&smoothed_line(&frame.seen_as(of.at(frame.frame)))))
        })?;
        let mut carrier = Carrier::for_frames(&self.plan.rig, smoothed.frames.count());
        self.tracked.recalibrated.iter().for_each(|(frame, rig)| carrier.recalibrate(*frame, rig));
        self.folder.write_tum("trajectory-smoothed.tum", of.last(), |put| {
            let mut before_s = f64::NEG_INFINITY;
            smoothed.each(|frame| {
                carrier.push(frame);
                // Of frames with equal times the first is used.
                let later = frame.time_s > before_s;
                before_s = before_s.max(frame.time_s);
                if !later {
                    return Ok(());
                }
                let of = of.at(frame.frame);
                put(&frame.seen_as(of).stamped(of))
            })
        })?;
        drop(path);
        let of = *carrier.of().last();
        let mut carrier = carrier.path();
        self.folder.write_tum("carrier.tum", &of, |put| carrier.try_for_each(|pose| put(&pose)))
    }

    /// Where the last frame was that a map of earlier runs recognised.
    fn place_in_map(&mut self, improved: &mut Improved) -> Result<Option<PlaceInMap>> {
        let mapper = self.tracked.mapping.mapper();
        if !PlaceInMap::can_be(mapper) {
            return Ok(None);
        }
        // Keyframes are where the camera was.
        let frames = improved.summaries(&mut self.tracked, &PoseFrame::Camera.into())?;
        let Some(place) = PlaceInMap::last(&frames, self.tracked.mapping.mapper()) else { return Ok(None) };
        drop(frames);
        let frames = improved.summaries(&mut self.tracked, &self.of)?;
        Ok(frames.iter().find(|frame| frame.frame == place.frame).map(|frame| place.of(frame)))
    }

    /// Where on Earth the run was; writes the path there.
    fn place_on_earth(
        &mut self,
        improved: &mut Improved,
        frames: &[FrameSummary],
    ) -> Result<Option<OnEarth>> {
        let on_earth = match self.ending.gnss {
            Some(gnss) => {
                let mut carrier = PoseFrames::of_carrier(&self.plan.rig);
                let tracked = &mut self.tracked;
                tracked.recalibrated.iter().for_each(|(frame, rig)| carrier.recalibrate(*frame, rig));
                let path = earth::antenna_path(
                    improved.corrected.as_mut().unwrap_or(&mut tracked.frames),
                    &carrier,
                    self.plan.antenna.as_ref(),
                )?;
                Some(gnss.place(self.plan, &path, frames, improved.bent))
            }
            None => None,
        };
        self.warn(on_earth.iter().flat_map(|on_earth| on_earth.warnings.clone()));
        let place = on_earth.as_ref().and_then(|on_earth| on_earth.place.as_ref());
        earth::write(self.folder, place, frames)?;
        Ok(on_earth)
    }

    /// The mosaic, the map and the page.
    fn draw(
        &mut self,
        corrected: Option<&mut KeptFrames>,
        frames: &[FrameSummary],
        sensors: &[SensorReport],
        markers: Option<&MarkerStatistics>,
        on_earth: Option<&OnEarth>,
    ) -> Result<()> {
        let Ending { description, reporter, observer, .. } = *self.ending;
        let threads = self.ending.output.threads();
        let tracked = &mut self.tracked;
        let corrected = corrected.unwrap_or(&mut tracked.frames);
        let rendered = tracked.views.render(&self.plan.camera, corrected, &mut tracked.mapping, threads);
        let mosaic = rendered.unwrap_or_else(|error| {
            self.fail("there is no picture of the ground", error);
            Mosaic::new(Default::default())
        });
        let compared = match (&self.plan.reference, reference::read(self.plan)?) {
            (Some(path), Some(read)) => reference::compared(path, read, self.folder.path())
                .map_err(|error| self.warn([format!("the path cannot be compared: {error}")]))
                .ok(),
            _ => None,
        };
        let loops = self.tracked.mapping.loops();
        let keyframes = self.tracked.mapping.own_places();
        let landmarks = markers.map_or_else(Vec::new, MarkerStatistics::drawn);
        let marks = std::mem::take(&mut self.tracked.marks);
        let tracked = &mut self.tracked;
        let shown = pictures::DrawingInputs {
            description,
            frames,
            loops: &loops,
            landmarks: &landmarks,
            keyframes: &keyframes,
            marks: &marks,
            mosaic: &mosaic,
            sensors,
            reference: compared.as_ref(),
        };
        let drawn = pictures::write(
            self.plan,
            &shown,
            &mut tracked.mapping,
            self.folder,
            reporter,
            threads,
            observer,
        )?;
        tracked.warnings.extend(match &drawn.ground {
            Ok(warning) => warning.clone(),
            Err(error) => Some(format!("the map has no new picture of the ground: {error}")),
        });
        if let Some(place) = on_earth.and_then(|on_earth| on_earth.place.as_ref()) {
            let path = self.folder.path().join(earth::UTM_MOSAIC);
            match tracked.mapping.write_geotiff(&path, &place.anchor) {
                Ok(true) => self.folder.is_written(path),
                Ok(false) => self.folder.remove(earth::UTM_MOSAIC)?,
                Err(error) => {
                    let warning = format!("there is no picture of the ground on Earth: {error}");
                    tracked.warnings.push(warning);
                    self.failure.get_or_insert(error);
                }
            }
        }
        let interruption = (tracked.interrupted && tracked.live.is_none())
            .then(|| interruption(frames.len() as u64, tracked.announced));
        pictures::write_page(
            self.plan,
            &shown,
            &drawn,
            &tracked.warnings,
            interruption.as_deref(),
            self.folder,
            reporter,
        )?;
        if let Err(error) = drawn.ground {
            self.failure.get_or_insert(error);
        }
        Ok(())
    }

    /// Closes the map and writes the statistics, the last file.
    fn end(
        mut self,
        frames: Vec<FrameSummary>,
        place: Option<PlaceInMap>,
        sensors: &[SensorReport],
        estimated: Estimated,
    ) -> Result<RunOutcome> {
        let map = self.tracked.mapping.written().map(Path::to_owned);
        let closed = self.tracked.mapping.close();
        let mapper = self.tracked.mapping.mapper();
        let looked_for = self.ending.output.map.is_read_only() && place.is_none();
        let statistics = statistics_of(
            &self.tracked,
            &frames,
            self.plan.budget,
            sensors,
            estimated,
            self.ending.started.elapsed(),
        );
        self.folder.finish(&statistics)?;
        match self.failure.or(closed.err()) {
            Some(error) => Err(error),
            None => Ok(RunOutcome {
                end: RunEnd::of(&statistics),
                statistics,
                trajectory: frames,
                resemblance: looked_for.then(|| Resemblance::of(mapper)).flatten(),
                place,
                warnings: self.tracked.warnings,
                folder: self.folder.path().to_owned(),
                written: self.folder.take_written().into_iter().chain(map).collect(),
            }),
        }
    }
}

/// The statistics of a run that took `elapsed`, from its final frames and its sensors.
fn statistics_of(
    tracked: &Tracked,
    frames: &[FrameSummary],
    budget: Option<Budget>,
    sensors: &[SensorReport],
    estimated: Estimated,
    elapsed: Duration,
) -> RunStatistics {
    let posed = |i: usize| frames[i].place.is_some();
    let losses = (0..frames.len()).filter(|&i| !posed(i) && (i == 0 || posed(i - 1))).count();
    let duration_s = match (frames.first(), frames.last()) {
        (Some(first), Some(last)) => last.time_s - first.time_s,
        _ => 0.0,
    };
    let rate = |s: f64| if s > 0.0 { frames.len() as f64 / s } else { 0.0 };
    RunStatistics {
        frames: frames.len() as u64,
        frames_with_pose: frames.iter().filter(|f| f.status == TrackStatus::Tracked).count() as u64,
        duration_s,
        distance_m: distance_m(frames),
        fps: rate(elapsed.as_secs_f64()),
        stages: BTreeMap::from([
            ("decode", StageTime::of(&tracked.times.decode)),
            ("track", StageTime::of(&tracked.times.track)),
            ("self_calibration", StageTime::of(&tracked.times.self_calibration)),
            ("map", StageTime::of(&tracked.times.map)),
        ]),
        keyframes: tracked.keyframes,
        losses: losses as u64,
        loops: estimated.loops,
        peak_memory_bytes: peak_memory_bytes(),
        budget: budget.map(|budget| BudgetStatistics::new(budget, &tracked.times.track)),
        mount: tracked.mount,
        lens: tracked.lens.clone(),
        readout: tracked.readout,
        interlaced: tracked.interlaced,
        fixed_in_image: tracked.fixed.clone(),
        interrupted: tracked.interrupted,
        frames_announced: tracked.announced.filter(|_| tracked.interrupted),
        live: tracked.live,
        markers: estimated.markers,
        sensors: sensors.iter().map(SensorStatistics::new).collect(),
        gnss: estimated.gnss,
    }
}

/// A smoothed path, its gaps filled from the sensors, along the frames.
struct FrameSmoother<'a> {
    frames: &'a mut KeptFrames,
    path: &'a SmoothedPath,
    reckoned: &'a Reckoned,
}

impl FrameSmoother<'_> {
    /// Visits every frame of the path. Fails if frames cannot be read back, or if `take` fails.
    fn each(&mut self, mut take: impl FnMut(&SmoothedFrame) -> Result<()>) -> Result<()> {
        let (mut walk, mut merge) = (self.path.walk(), self.reckoned.merge());
        let mut taken = Ok(());
        let mut take = |frame: SmoothedFrame, taken: &mut Result<()>| {
            if taken.is_ok() {
                *taken = take(&frame);
            }
        };
        self.frames.each(|frame, _| {
            walk.next(frame, &mut |smoothed| {
                merge.next(smoothed, &mut |smoothed| take(smoothed, &mut taken));
            });
            std::mem::replace(&mut taken, Ok(()))
        })?;
        merge.end(&mut |smoothed| take(smoothed, &mut taken));
        taken
    }
}
