//! The rig from pictures and clips of a board on the floor.

use super::{CAMERA_UNKNOWN, GroundArguments, RigMeasurement, read_camera};
use crate::{console, interrupt};
use odograph::error::{Error, Result};
use odograph::formats::decimal::Rounded;
use odograph::image::{GrayImage, RgbImage};
use odograph_calibration::{Board, BoardFinder, BoardView, seen_instead};
use odograph_calibration::{BoardMounting, FloorBoard, rig_from_boards};

/// More views than this add no information.
const MAX_VIEWS: usize = 100;

/// Views in which the board moved by less than this since the last one are duplicates, pixels.
const MOVED_PX: f64 = 3.0;

/// Number of pictures for which the reason of their exclusion is printed, and that are searched for
/// another board if there is none in any.
const MAX_TOLD: usize = 8;

/// What was found in all sources.
struct BoardSightings {
    views: Vec<BoardView>,
    names: Vec<String>,
    frames: usize,
    /// Frames that show the board at the same place as before.
    still: usize,
    /// Names of the frames without the board, and why.
    without: Vec<(String, String)>,
    /// The first of these frames.
    images_without: Vec<GrayImage>,
    first: Option<RgbImage>,
    warnings: Vec<String>,
}

pub fn measure(arguments: &GroundArguments, board: Board) -> Result<RigMeasurement> {
    let floor =
        FloorBoard { board, thickness_m: arguments.thickness.unwrap_or(0.0), forward: arguments.forward };
    let found = look(arguments, &board)?;
    let Some(frame) = found.first else {
        let why = found
            .without
            .first()
            .map_or("there is no picture".to_owned(), |(name, why)| format!("{why} in {name}"));
        let instead = seen_instead(&board, &found.images_without).map_or_else(String::new, |instead| {
            format!("; {instead}: state that board, with the lengths of your print")
        });
        return Err(Error::input(format!(
            "no {board} was seen on the floor in {}: {why}{instead}",
            match found.frames {
                1 => "the picture".to_owned(),
                frames => format!("any of {frames} pictures"),
            }
        )));
    };
    let size = found.views[0].size;
    let (camera, uncertainty) = read_camera(&arguments.camera, arguments.source(), size)?;
    let mounting = rig_from_boards(&camera, uncertainty.as_ref(), &floor, &found.views)?;
    let mut warnings = found.warnings;
    for (name, why) in found.without.iter().take(MAX_TOLD) {
        warnings.push(format!("{name} is left out: {why}"));
    }
    if found.without.len() > MAX_TOLD {
        warnings.push(format!("{} more pictures show no board", found.without.len() - MAX_TOLD));
    }
    for (view, name) in mounting.views.iter().zip(&found.names) {
        if let Some(why) = &view.why_not {
            warnings.push(format!("{name} is left out: {why}"));
        }
    }
    warnings.extend(mounting.notes.iter().cloned());
    warnings.extend(uncertainty.is_none().then(|| CAMERA_UNKNOWN.to_owned()));
    Ok(RigMeasurement {
        rig: mounting.measured,
        summary: summary(&board, &mounting, &found.names, found.still),
        warnings,
        points: found.views[0].points.iter().map(|point| point.pixel).collect(),
        frame,
        forward_known: mounting.measured.deviations.yaw_rad.is_some(),
    })
}

/// Looks for the board in every frame of every source.
fn look(arguments: &GroundArguments, board: &Board) -> Result<BoardSightings> {
    let finder = BoardFinder::new(board);
    let mut found = BoardSightings {
        views: Vec::new(),
        names: Vec::new(),
        frames: 0,
        still: 0,
        without: Vec::new(),
        images_without: Vec::new(),
        first: None,
        warnings: Vec::new(),
    };
    for path in &arguments.sources {
        let mut source = odograph_session::open_recording(path, &arguments.source_options())?;
        let single = source.info().frame_count == Some(1);
        while let Some(frame) = source.next_frame()? {
            if interrupt::asked() {
                return Err(Error::usage("interrupted; nothing was written"));
            }
            if found.views.len() >= MAX_VIEWS {
                break;
            }
            found.frames += 1;
            let name = if single { path.clone() } else { format!("frame {} of {path}", frame.number) };
            match finder.find(&frame.gray) {
                Err(why) => {
                    found.without.push((name, why.to_string()));
                    if found.images_without.len() < MAX_TOLD {
                        found.images_without.push(frame.gray);
                    }
                }
                Ok(view) if found.views.last().is_some_and(|last| is_same(last, &view)) => found.still += 1,
                Ok(view) => {
                    if found.first.is_none() {
                        found.first = Some(frame.rgb());
                    }
                    found.views.push(view);
                    found.names.push(name);
                }
            }
        }
        // Timestamps do not matter here.
        let warnings = source.take_warnings();
        found.warnings.extend(warnings.into_iter().filter(|w| !w.contains("when the frames were taken")));
    }
    Ok(found)
}

/// Whether the board has not moved.
fn is_same(last: &BoardView, view: &BoardView) -> bool {
    if last.size != view.size {
        return false;
    }
    let mut moved: Vec<f64> = Vec::new();
    for point in &view.points {
        if let Ok(index) = last.points.binary_search_by_key(&point.index, |seen| seen.index) {
            moved.push(point.pixel.distance(last.points[index].pixel));
        }
    }
    !moved.is_empty() && moved.iter().sum::<f64>() / (moved.len() as f64) < MOVED_PX
}

/// A table of the views, and what they were made of.
fn summary(board: &Board, mounting: &BoardMounting, names: &[String], still: usize) -> String {
    let used = mounting.views.iter().filter(|view| view.why_not.is_none()).count();
    let mut text = format!("\n{used} of {} views of {board}", mounting.views.len());
    if still > 0 {
        text += &format!(" ({still} more frames show it at the same place)");
    }
    text.push('\n');
    if mounting.views.len() > 1 {
        let [height, roll, pitch] = mounting.scatter;
        text += &format!(
            "from view to view, beyond the noise: height {:.2} mm, roll {:.3}°, pitch {:.3}°\n",
            height * 1e3,
            roll.to_degrees(),
            pitch.to_degrees()
        );
    }
    let names: Vec<String> = names.iter().map(console::name).collect();
    let width = names.iter().map(|name| name.chars().count()).max().unwrap_or(0).min(40);
    for (view, name) in mounting.views.iter().zip(&names) {
        let Some(pose) = view.pose else {
            text += &format!("  {name:<width$}  left out\n");
            continue;
        };
        text += &format!(
            "  {name:<width$}  {:.4} m  {:8.3}°  {:8.3}°  rms {:.3} px{}\n",
            pose.height_m,
            Rounded(pose.roll_rad.to_degrees()),
            Rounded(pose.pitch_rad.to_degrees()),
            view.rms_px,
            if view.why_not.is_some() { "  left out" } else { "" }
        );
    }
    text
}
