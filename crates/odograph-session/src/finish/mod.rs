//! The end of a run: smoothing, sensor fusion and loop correction, output files and drawings.
//! Trajectories are written first, because they cannot be recovered without the recording. What
//! fails after that is left out, and is reported after everything else has been written.

mod abrupt;
mod improvement;
mod smoothing;
mod statistics;

use crate::earth::{self, Antenna, FOUND_RIG, GnssRecord, OnEarth, RECEIVED_FIXES};
use crate::folder::{OutputFolder, RUN_FILES};
use crate::found::{FoundLens, FoundReadout};
use crate::found_rig::{self, FoundMounting};
use crate::kept_frames::KeptFrames;
use crate::marker_statistics::MarkerStatistics;
use crate::observer::Observer;
use crate::outcome::{RunEnd, RunOutcome};
use crate::output::RunOutput;
use crate::pictures::PageTexts;
use crate::pipeline::Tracked;
use crate::place::PoseInMap;
use crate::plan::RunPlan;
use crate::reference::ReferencePath;
use crate::report::{ReportLocalization, RunReporter};
use crate::resemblance::{Resemblance, ResemblanceVerdict};
use crate::ros_bag::RosBagWriter;
use crate::statistics::stopped_early;
use crate::stillness::stillness_warning;
use crate::{files, pictures, tilt};
use abrupt::widen_abrupt;
use improvement::{Improved, carrier_frames};
use odograph::drawing::ReckonedStretch;
use odograph::error::{Error, Result};
use odograph::filter::fusion::{SensorReport, Sensors};
use odograph::formats::{camera_file, rig_file};
use odograph::georeference::Anchor;
use odograph::image::ImageDefects;
use odograph::mosaic::Mosaic;
use odograph::pose_frame::{PoseFrame, PoseFrames};
use odograph::trajectory::FrameSummary;
use smoothing::write_smoothed;
use statistics::{Estimated, statistics_of};
use std::path::Path;
use std::time::Instant;

/// Inputs for finishing a run.
pub struct Ending<'a> {
    /// Description of the recording.
    pub description: &'a str,
    pub sensors: &'a Sensors,
    /// Positions by a satellite receiver.
    pub gnss: Option<&'a GnssRecord>,
    /// A path to compare with.
    pub reference: Option<&'a ReferencePath>,
    pub output: &'a RunOutput,
    pub reporter: Option<&'a dyn RunReporter>,
    pub observer: &'a dyn Observer,
    /// When the run began.
    pub started: Instant,
}

/// Improves the trajectory and writes everything into the folder. Warnings of a live run that
/// fails, of which there is no outcome, are given to the observer: nobody can do that run again.
pub fn finish(
    plan: &RunPlan,
    mut tracked: Tracked,
    folder: &mut OutputFolder,
    ending: &Ending<'_>,
) -> Result<RunOutcome> {
    enough(plan, &mut tracked, ending.output)
        .inspect_err(|error| give_warnings(live_warnings(&tracked), error, ending.observer))?;
    let mut pose_frames = PoseFrames::from(plan.pose_frame()?);
    tracked.recalibrated.iter().for_each(|(frame, rig)| pose_frames.recalibrate(*frame, rig));
    let (reckoned, failures) = (Vec::new(), Vec::new());
    let mut run = Finishing { plan, pose_frames, tracked, reckoned, folder, ending, failure: None, failures };
    run.finish().inspect_err(|error| {
        // The warnings of a live run name its failures, too.
        let told = if run.tracked.live.is_some() { &run.tracked.warnings } else { &run.failures };
        give_warnings(told, error, ending.observer);
    })
}

fn live_warnings(tracked: &Tracked) -> &[String] {
    if tracked.live.is_some() { &tracked.warnings } else { &[] }
}

/// Gives the observer the warnings that say more than the error that follows them.
pub fn give_warnings(warnings: &[String], error: &Error, observer: &dyn Observer) {
    let error = error.to_string();
    warnings.iter().filter(|warning| !warning.contains(&error)).for_each(|warning| observer.warn(warning));
}

/// The camera file with the estimated lens, where it differs from the plan.
const FOUND_CAMERA: &str = "camera-found.yaml";

/// Maximum number of pixels of a map in the report: some megabytes.
const MAP_PIXELS: usize = 4_000_000;

/// The mask of what is static in the image.
const MASK: &str = "mask.png";

/// A run that is being finished.
struct Finishing<'a> {
    plan: &'a RunPlan,
    /// The frame whose poses are written and shown.
    pose_frames: PoseFrames,
    /// Frames of the camera in the odometry frame.
    tracked: Tracked,
    /// The stretches of the path that other sensors have given.
    reckoned: Vec<ReckonedStretch>,
    folder: &'a mut OutputFolder,
    ending: &'a Ending<'a>,
    /// The error that ended the recording early, or the first that prevented an output.
    failure: Option<Error>,
    /// What ended early or is missing because of such errors, a sentence each.
    failures: Vec<String>,
}

/// Warning about interlaced video.
const INTERLACED: &str = "the video is interlaced: even and odd rows of a frame are of different times, and the even ones \
                          alone are used; a camera set to progressive video gives twice as many rows";

/// Warnings about noise that is corrected, but costs accuracy.
const ROW_NOISE: &str = "rows of the images are brighter or darker at random, which was corrected; more light, or a \
                         better cable of an analog camera, gives better images";
const COLUMN_NOISE: &str = "columns of the images are brighter or darker at random, which was corrected; more light, or \
                            a better sensor, gives better images";
const IMPULSE_NOISE: &str = "single pixels of the images are white or black at random, which was corrected; a better \
                             connection, or a cooler sensor, gives better images";

const PIXEL_NOISE: &str = "single pixels of the images are mostly noise, so they were tracked at a coarser resolution; more \
                           light, and a camera that sharpens and filters less, give better images";

/// Fails if there are too few frames for a trajectory.
fn enough(plan: &RunPlan, tracked: &mut Tracked, output: &RunOutput) -> Result<()> {
    if tracked.frames.count() >= output.least_frames || tracked.interrupted {
        return Ok(());
    }
    let too_few = if tracked.frames.count() == 0 { "no frame" } else { "only one frame" };
    Err(tracked.failure.take().unwrap_or_else(|| {
        Error::input(format!(
            "{} has {too_few}{}; a movement needs at least two{}",
            plan.source.path,
            if plan.source.is_whole() { "" } else { " in the chosen range" },
            // What is done with a single picture.
            if tracked.frames.count() == 1 { " (odograph localize finds one in a map)" } else { "" }
        ))
    }))
}

/// Warning about a readout time that is longer than the mean interval between frames.
fn impossible_readout(plan: &RunPlan, frames: &KeptFrames) -> Option<String> {
    let readout_s = plan.camera.readout_s()?;
    let duration_s = frames.last()?.time_s - frames.first_time_s()?;
    let interval_s = duration_s / frames.count().checked_sub(1).filter(|steps| *steps > 0)? as f64;
    (readout_s > interval_s).then(|| {
        format!(
            "the readout time is {:.1} ms, longer than the {:.1} ms from one frame to the next; correct --readout-ms, or \
             leave it away and it is estimated",
            1e3 * readout_s,
            1e3 * interval_s
        )
    })
}

impl Finishing<'_> {
    /// The steps of the end, one after the other.
    fn finish(&mut self) -> Result<RunOutcome> {
        let (plan, ending, pose_frames) = (self.plan, self.ending, self.pose_frames.clone());
        self.report_early_end();
        self.report_calibration()?;
        self.warn(impossible_readout(plan, &self.tracked.frames));
        let abrupt = widen_abrupt(&mut self.tracked.frames, self.folder.path())?;
        self.warn(abrupt);
        let mut improved =
            Improved::new(&mut self.tracked, plan, ending.sensors, ending.gnss, self.folder.path())?;
        self.write_paths(&mut improved)?;
        self.report_video();
        improved.observe(&mut self.tracked, &pose_frames, ending.observer)?;
        let frames = improved.summaries(&mut self.tracked, &pose_frames)?;
        let place = self.place_in_map(&mut improved)?;
        let resemblance = self.resemblance(place.as_ref());
        let on_earth = self.place_on_earth(&mut improved, &frames)?;
        let Improved { mut corrected, sensors, loops, markers, .. } = improved;
        // The page of a live run shows the mosaic, too.
        if ending.output.draws() || self.tracked.live.is_some() {
            let found = (place.as_ref(), resemblance.as_ref());
            self.draw(corrected.as_mut(), &frames, &sensors, markers.as_ref(), on_earth.as_ref(), found);
        }
        let estimated = Estimated { loops, markers, gnss: on_earth.map(|on_earth| on_earth.statistics) };
        self.end(frames, (place, resemblance), &sensors, estimated)
    }

    fn warn(&mut self, warning: impl IntoIterator<Item = String>) {
        self.tracked.warnings.extend(warning);
    }

    /// An output other than the trajectories failed: the run continues and fails at the end.
    fn fail(&mut self, what: &str, error: Error) {
        let sentence = format!("{what}: {error}");
        self.failures.push(sentence.clone());
        self.warn([sentence]);
        self.failure.get_or_insert(error);
    }

    /// What an output made, or its default where it failed; see [`Finishing::fail`].
    fn or_without<T: Default>(&mut self, what: &str, output: Result<T>) -> T {
        output.unwrap_or_else(|error| {
            self.fail(what, error);
            T::default()
        })
    }

    /// The errors that ended the recording or its map early.
    fn report_early_end(&mut self) {
        if let Some(error) = self.tracked.failure.take() {
            self.fail("the recording ended early", error);
        }
        if let Some(error) = self.tracked.unmapped.take() {
            self.fail("the map ended early", error);
        }
    }

    /// Warns where the estimated mount, lens or readout time differs from the plan, and where
    /// nothing moves.
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
        // To find a place has no option for it, and needs no path that is free of it.
        if !self.ending.output.localizes() {
            let reads = self.tracked.readout.as_ref().and_then(FoundReadout::sentence);
            self.warn(reads);
        }
        let ImageDefects { interlaced, row_noise, column_noise, impulse_noise, pixel_noise } =
            self.tracked.defects;
        let defects = [
            (interlaced, INTERLACED),
            (row_noise, ROW_NOISE),
            (column_noise, COLUMN_NOISE),
            (impulse_noise, IMPULSE_NOISE),
            (pixel_noise, PIXEL_NOISE),
        ];
        for (_, warning) in defects.into_iter().filter(|(is_there, _)| *is_there) {
            self.warn(Some(warning.to_owned()));
        }
        // A camera may well stand where it asks for its place.
        if !self.ending.output.localizes() {
            let stands = stillness_warning(&mut self.tracked.frames, &self.plan.camera)?;
            self.warn(stands);
        }
        Ok(())
    }

    /// Writes the trajectories, the map's keyframes, and the paths derived from the frames.
    fn write_paths(&mut self, improved: &mut Improved) -> Result<()> {
        let frames = improved.corrected.as_mut().unwrap_or(&mut self.tracked.frames);
        let text = self.plan.text_in(self.folder.path())?;
        self.folder.write_trajectories(frames, &self.pose_frames, &text)?;
        if let Some(received) = self.ending.gnss.and_then(GnssRecord::received_csv) {
            let written = self.folder.write(RECEIVED_FIXES, received.as_bytes());
            self.or_without("the positions of the receiver are not kept", written);
        }
        let written = self.write_found_camera();
        self.or_without("the estimated lens is not kept", written);
        let written = match &self.tracked.fixed.mask {
            Some(mask) => files::png_from_gray(&mask.picture()).and_then(|png| self.folder.write(MASK, &png)),
            None => self.folder.remove(MASK),
        };
        self.or_without("the mask is not kept", written);
        let pose_frames = &self.pose_frames;
        let written = self.folder.write_tum("odometry.tum", pose_frames.last(), |put| {
            self.tracked.frames.each(|frame, _| pose_frames.stamped(frame).as_ref().map_or(Ok(()), &mut *put))
        });
        self.or_without("there is no path as odometry had it", written);
        // The map comes after the trajectories because it may not fit on the disk.
        let frames = improved.corrected.as_mut().unwrap_or(&mut self.tracked.frames);
        let saved = self.tracked.mapping.save(frames, self.tracked.fixed.mask.as_ref());
        self.or_without("the map is not where the trajectories are", saved);
        let frames = improved.corrected.as_mut().unwrap_or(&mut self.tracked.frames);
        let recalibrated = &self.tracked.recalibrated;
        let smoothed = write_smoothed(
            frames,
            &improved.reckoned,
            self.plan,
            recalibrated,
            &self.pose_frames,
            self.folder,
        );
        self.reckoned = self.or_without("there is no smoothed path", smoothed);
        if let Some(bag) = &self.ending.output.bag {
            let written = self.write_bag(bag, improved);
            self.or_without("there is no bag", written);
        }
        Ok(())
    }

    /// The camera file with the estimated lens. One of an earlier run that is the input of this one
    /// is kept.
    fn write_found_camera(&mut self) -> Result<()> {
        let camera = camera_file::write(&self.plan.camera);
        match self.tracked.lens {
            Some(_) => self.folder.write(FOUND_CAMERA, camera.as_bytes()),
            None if self.folder.holds(FOUND_CAMERA, camera.as_bytes()) => Ok(()),
            None => self.folder.remove(FOUND_CAMERA),
        }
    }

    /// Reports the overlay video, which was written while tracking.
    fn report_video(&mut self) {
        match self.tracked.video.take() {
            Some(Ok(warning)) => {
                self.folder.is_written(self.ending.output.video.clone().unwrap_or_default());
                self.warn(warning);
            }
            Some(Err(error)) => self.fail("there is no overlay video", error),
            None => {}
        }
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
            let mut bag = RosBagWriter::new(path, output, self.pose_frames.clone())?;
            self.tracked.frames.each(|frame, _| bag.add(frame, in_map.next().flatten().as_ref()))?;
            bag.finish()
        })?;
        self.folder.is_written(path.to_owned());
        Ok(())
    }

    /// Where the last frame was that a map of earlier runs recognised.
    fn place_in_map(&mut self, improved: &mut Improved) -> Result<Option<PoseInMap>> {
        let mapper = self.tracked.mapping.mapper();
        if !PoseInMap::can_be(mapper) {
            return Ok(None);
        }
        // Keyframes are where the camera was.
        let frames = improved.summaries(&mut self.tracked, &PoseFrame::Camera.into())?;
        let Some(place) = PoseInMap::last(&frames, self.tracked.mapping.mapper()) else { return Ok(None) };
        drop(frames);
        let frames = improved.summaries(&mut self.tracked, &self.pose_frames)?;
        Ok(frames.iter().find(|frame| frame.frame == place.frame).map(|frame| place.of(frame)))
    }

    /// What of the map that was looked into resembles a run that has no place there.
    fn resemblance(&self, place: Option<&PoseInMap>) -> Option<Resemblance> {
        let mapping = &self.tracked.mapping;
        let looked_for = self.ending.output.map.path().is_some() && place.is_none();
        looked_for.then(|| Resemblance::of(mapping.mapper(), mapping.other_scale())).flatten()
    }

    /// Where on Earth the run was; writes the path there.
    fn place_on_earth(
        &mut self,
        improved: &mut Improved,
        summaries: &[FrameSummary],
    ) -> Result<Option<OnEarth>> {
        let on_earth = match self.ending.gnss {
            Some(gnss) => {
                let carrier = carrier_frames(self.plan, &self.tracked.recalibrated);
                let frames = improved.corrected.as_mut().unwrap_or(&mut self.tracked.frames);
                let path = earth::antenna_path(frames, &carrier, &improved.antenna)?;
                Some(gnss.place(self.plan, &improved.antenna, &path, summaries, improved.bent))
            }
            None => None,
        };
        self.warn(on_earth.iter().flat_map(|on_earth| on_earth.warnings.clone()));
        let written = self.write_found_rig(&improved.antenna, &improved.sensors);
        self.or_without("the mount that was found is not kept", written);
        let place = on_earth.as_ref().and_then(|on_earth| on_earth.place.as_ref());
        let written = earth::write(self.folder, place, summaries);
        self.or_without("there is no path on Earth", written);
        Ok(on_earth)
    }

    /// The rig file with what was found of camera and antenna. One of an earlier run that is the
    /// input of this one is kept.
    fn write_found_rig(&mut self, antenna: &Antenna, sensors: &[SensorReport]) -> Result<()> {
        let rig = &self.plan.rig;
        let mounting = FoundMounting::of(sensors, rig);
        if let Some(found) = found_rig::text(rig, mounting.as_ref(), antenna) {
            if let Some(mounting) = mounting {
                self.ending.observer.note(&mounting.sentence());
            }
            return self.folder.write(FOUND_RIG, found.as_bytes());
        }
        let there = files::read_text(&self.folder.path().join(FOUND_RIG));
        let is_input = |text: &String| {
            rig_file::parse(text).is_ok_and(|there| there.lever_arm == rig.lever_arm)
                && rig_file::parse_antenna(text).is_ok_and(|there| there == antenna.stated_at())
        };
        match rig.lever_arm.is_some() && there.is_ok_and(|text| is_input(&text)) {
            true => Ok(()),
            false => self.folder.remove(FOUND_RIG),
        }
    }

    /// The mosaic, the map and the page.
    fn draw(
        &mut self,
        corrected: Option<&mut KeptFrames>,
        frames: &[FrameSummary],
        sensors: &[SensorReport],
        markers: Option<&MarkerStatistics>,
        on_earth: Option<&OnEarth>,
        (place, resemblance): (Option<&PoseInMap>, Option<&Resemblance>),
    ) {
        let Ending { description, reporter, observer, reference, .. } = *self.ending;
        let threads = self.ending.output.threads();
        let tracked = &mut self.tracked;
        let corrected = corrected.unwrap_or(&mut tracked.frames);
        let mut mosaic = Mosaic::new(Default::default());
        mosaic.set_mask(tracked.fixed.mask.clone());
        let rendered =
            tracked.views.render(mosaic, &self.plan.camera, corrected, &mut tracked.mapping, threads);
        let mosaic = self.or_without("there is no picture of the ground", rendered.map(Some));
        let mosaic = mosaic.unwrap_or_else(|| Mosaic::new(Default::default()));
        let compared = reference.and_then(|reference| {
            reference
                .compared(self.folder.path())
                .map_err(|error| self.warn([format!("the path cannot be compared: {error}")]))
                .ok()
        });
        let loops = self.tracked.mapping.loops();
        let keyframes = self.tracked.mapping.own_places();
        let landmarks = markers.map_or_else(Vec::new, MarkerStatistics::drawn);
        let marks = std::mem::take(&mut self.tracked.marks);
        let reckoned = std::mem::take(&mut self.reckoned);
        let tracked = &mut self.tracked;
        let shown = pictures::DrawingInputs {
            description,
            frames,
            reckoned: &reckoned,
            loops: &loops,
            landmarks: &landmarks,
            keyframes: &keyframes,
            marks: &marks,
            mosaic: &mosaic,
            sensors,
            reference: compared.as_ref(),
        };
        let mapping = &mut tracked.mapping;
        let drawn = pictures::write(self.plan, &shown, mapping, self.folder, reporter, threads, observer);
        let warning = self.or_without("the map has no new picture of the ground", drawn.ground);
        self.warn(warning);
        for (what, failure) in drawn.failures {
            self.fail(what, failure);
        }
        if let Some(place) = on_earth.and_then(|on_earth| on_earth.place.as_ref()) {
            let written = self.write_earth_mosaic(&place.anchor);
            self.or_without("there is no picture of the ground on Earth", written);
        }
        let looked_into = self.ending.output.map.path().filter(|_| self.ending.output.localizes());
        let ground = looked_into.map_or(Ok(None), |_| self.tracked.mapping.ground_within(MAP_PIXELS));
        let ground = self.or_without("the report has no picture of the map", ground);
        let tracked = &self.tracked;
        let early = || stopped_early(frames.len() as u64, tracked.announced, tracked.live.as_ref());
        let interruption = tracked.interrupted.then(early).flatten();
        let beside = files_beside(self.folder, tracked.mapping.written());
        let alike = resemblance.map_or(&[][..], |resemblance| &resemblance.places);
        let verdict = resemblance.map_or(ResemblanceVerdict::TooFewFeatures, |one| one.verdict);
        let reason = match (place, looked_into) {
            (None, Some(map)) => verdict.sentence("the recording", map, alike.len()),
            _ => String::new(),
        };
        let localization = looked_into.map(|_| ReportLocalization {
            place,
            reason: &reason,
            alike,
            ground: ground.as_ref(),
        });
        let told = PageTexts {
            warnings: &tracked.warnings,
            interruption: interruption.as_deref(),
            files: &beside,
            localization,
        };
        let written = pictures::write_page(self.plan, &shown, &drawn.drawing, &told, self.folder, reporter);
        self.or_without("there is no report", written);
    }

    /// The mosaic in UTM, where it is known where on Earth the run was.
    fn write_earth_mosaic(&mut self, anchor: &Anchor) -> Result<()> {
        let path = self.folder.path().join(earth::UTM_MOSAIC);
        match self.tracked.mapping.write_geotiff(&path, anchor)? {
            true => self.folder.is_written(path),
            false => self.folder.remove(earth::UTM_MOSAIC)?,
        }
        Ok(())
    }

    /// Closes the map and writes the statistics, the last file.
    fn end(
        &mut self,
        frames: Vec<FrameSummary>,
        (place, resemblance): (Option<PoseInMap>, Option<Resemblance>),
        sensors: &[SensorReport],
        estimated: Estimated,
    ) -> Result<RunOutcome> {
        let map = self.tracked.mapping.written().map(Path::to_owned);
        let closed = self.tracked.mapping.close();
        let statistics = statistics_of(
            &self.tracked,
            &frames,
            self.plan.budget,
            sensors,
            estimated,
            self.ending.started.elapsed(),
        );
        self.folder.finish(&statistics)?;
        match self.failure.take().or(closed.err()) {
            Some(error) => Err(error),
            None => Ok(RunOutcome {
                end: RunEnd::of(&statistics),
                statistics,
                trajectory: frames,
                resemblance,
                place,
                warnings: std::mem::take(&mut self.tracked.warnings),
                folder: self.folder.path().to_owned(),
                written: self.folder.take_written().into_iter().chain(map).collect(),
            }),
        }
    }
}

/// Names of the files in the folder that the report can name, in the order of `RUN_FILES`: those
/// that were written, the map, and the statistics, which are written last.
fn files_beside(folder: &OutputFolder, map: Option<&Path>) -> Vec<&'static str> {
    let is_there = |name: &str| {
        let path = folder.path().join(name);
        name == "stats.json" || folder.has_written(&path) || map == Some(path.as_path())
    };
    RUN_FILES.into_iter().filter(|name| *name != "report.html" && is_there(name)).collect()
}
