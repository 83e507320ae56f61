//! `odograph map merge`: joins maps that overlap.

use super::{info::pieces, mosaic};
use crate::{Outcome, console, files, interrupt};
use odograph::error::{Error, Result};
use odograph::ground_map::KeyframeStore;
use odograph::ground_map::{GroundMap, KeyframeImage, KeyframeImages, MapKeyframe, MountedCamera};
use odograph::keyframe::{KeyframeId, MapEdge};
use odograph::landmark::{MarkerSighting, PlacedSighting};
use odograph::loop_closure::LoopClosure;
use odograph::loop_closure::LoopClosureConfig;
use odograph::odometry::OdometryConfig;
use odograph::place_recognition::{PlaceIndex, PlacesConfig};
use odograph::slam::{self, Mapper, PlaceScale, SessionScale};
use odograph_map::{KeyframeMove, MapClaim, MapFile, MapMarker, Session, corrected_path};
use odograph_session::other_height;
use std::fs;
use std::path::{Path, PathBuf};

/// Join maps of the same cameras with common ground.
///
/// The first one's frame is kept; the others are recognised in it. Sessions that are in it already
/// are left out.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct MergeArguments {
    /// The maps, two or more: each must overlap one before it. They are not changed.
    #[arg(value_name = "MAP", num_args = 2.., required = true)]
    maps: Vec<PathBuf>,
    /// The joined map.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// What may change between frames: as when the maps were made.
    #[arg(long, value_name = "MODEL", default_value = "auto")]
    motion: crate::commands::run::Motion,
    /// Overwrite the joined map if it exists.
    #[arg(long)]
    force: bool,
    /// Say nothing but errors.
    #[arg(short, long)]
    quiet: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph map merge monday/map.gpkg tuesday/map.gpkg -o hall.gpkg
  odograph map merge north.gpkg middle.gpkg south.gpkg -o yard.gpkg";

/// Runs the command.
pub fn merge(arguments: &MergeArguments) -> Result<Outcome> {
    files::check_output_file(&arguments.output, arguments.force)?;
    check_different(&arguments.maps)?;
    let _made = files::MadeFolders::of_file(&arguments.output)?;
    let claim = MapClaim::on(&arguments.output)?;
    let [first, others @ ..] = arguments.maps.as_slice() else {
        return Err(Error::usage("give two maps or more to join"));
    };
    let summary =
        super::replaced(&claim, &arguments.output, |beside| joined(first, others, beside, arguments))?;
    if !arguments.quiet {
        console::print(&format!("{summary}Wrote {}\n", console::name(&arguments.output)))?;
    }
    Ok(Outcome::Done)
}

/// Refuses a map that is given twice, under any name: it would be joined to itself.
fn check_different(maps: &[PathBuf]) -> Result<()> {
    let files: Vec<Option<PathBuf>> = maps.iter().map(|path| fs::canonicalize(path).ok()).collect();
    for (at, file) in files.iter().enumerate() {
        if file.is_some() && files[..at].contains(file) {
            return Err(Error::usage(format!(
                "{} is given twice; a map cannot be joined to itself",
                maps[at].display()
            )));
        }
    }
    Ok(())
}

/// Makes the joined map; returns the summary to print.
fn joined(first: &Path, others: &[PathBuf], path: &Path, arguments: &MergeArguments) -> Result<String> {
    MapFile::open_read_only(first)?.copy_to(path)?;
    let mut file = MapFile::open(path)?;
    if file.map()?.keyframes.is_empty() {
        return Err(Error::input(format!(
            "{} has no keyframes; there is nothing to join to",
            first.display()
        )));
    }
    let mut summary = String::new();
    let mut finest_m = file.mosaic()?.map(|layer| layer.resolution_m);
    for other in others {
        let (back, added) = join(file, other, arguments)?;
        file = back;
        if let Some(warning) = added.warning.as_ref().filter(|_| !arguments.quiet) {
            console::warn(warning);
        }
        summary += &format!(
            "{}: {} keyframes, seen again in {} places{}\n",
            console::name(other),
            added.merged.keyframes,
            added.merged.loops,
            match added.merged.markers {
                0 => String::new(),
                ties => format!(", tied {ties} times by markers"),
            }
        );
        finest_m = match (finest_m, added.mosaic_m) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        };
    }
    let map = file.map()?;
    summary += &match pieces(&map) {
        1 => String::new(),
        pieces => format!("{pieces} pieces without a connection: their relative position is not known\n"),
    };
    if finest_m.is_some() {
        mosaic::rendered(&mut file, finest_m, arguments.quiet)?;
    }
    file.close()?;
    Ok(summary)
}

/// The contribution of a map.
struct Added {
    merged: slam::Merged,
    /// Side of a ground pixel of its mosaic, if it has one.
    mosaic_m: Option<f64>,
    /// A warning that its metres are not those of the others.
    warning: Option<String>,
}

/// Joins one more map.
fn join(mut file: MapFile, path: &Path, arguments: &MergeArguments) -> Result<(MapFile, Added)> {
    let mut other = MapFile::open_read_only(path)?;
    let mosaic_m = other.mosaic()?.map(|layer| layer.resolution_m);
    let map = file.map()?;
    let mut added = other.map()?;
    let new = new_sessions((&mut file, &map), (&mut other, &added), arguments)?;
    added.keyframes.retain(|keyframe| new.iter().any(|session| session.id == keyframe.session));
    let sessions = renumbered(&mut file, new, &mut added)?;
    let before = added.keyframes.clone();
    let height_m = other.rig().height_m;
    let places = KnownPlaces::new(&map);
    let mut odometry = OdometryConfig::default();
    odometry.motion.model = arguments.motion.into();
    let beginning = file.next_keyframe()?;
    let last = map.keyframes.iter().map(|keyframe| keyframe.session).max().unwrap_or(0);
    let mut mapper = Mapper::continuing(map, &odometry, LoopClosureConfig::default(), last + 1, beginning);
    let pictures = MapFile::open_read_only(path)?;
    let mut markers = MarkerNumbers::default();
    let here = markers.of_all(file.markers()?);
    let common = markers.of_all(other.markers()?);
    let mut store = Joined { file, other: pictures, beginning: beginning.0 };
    let common: Vec<MarkerSighting> = common.iter().map(|placed| placed.sighting).collect();
    mapper.remember_sightings(here);
    let merged = slam::merge(&mut mapper, &mut store, &added, &mut other, &common)?;
    if merged.loops + merged.markers == 0 {
        return Err(Error::input(format!(
            "no ground of {} was recognised in {}, so their relative position is not known; a \
             drive over ground of both, with run --map, connects them",
            path.display(),
            before_it(arguments)
        )));
    }
    let scale = places.scale_of(&before, beginning, mapper.closures());
    let warning = scale.filter(SessionScale::is_doubtful).map(|scale| {
        let camera = other_height(&format!("the camera of {}", console::name(path)), &scale, height_m);
        format!(
            "by the ground that was recognised in {} {camera}: check height and focal length of both maps",
            before_it(arguments)
        )
    });
    let mut file = store.file;
    let keyframes = &mapper.map().keyframes;
    let poses: Vec<_> = keyframes.iter().map(|k| (k.id, k.pose, k.covariance)).collect();
    file.set_poses(&poses)?;
    for placed in mapper.own_sightings() {
        let (family, size_m, placed) = markers.as_printed(placed);
        file.add_markers(family, size_m, &[placed])?;
    }
    for (old, new) in sessions {
        let own = before.iter().filter(|keyframe| keyframe.session == new);
        let moved = |keyframe: &MapKeyframe| {
            let id = KeyframeId(beginning.0 + keyframe.id.0);
            let now = keyframes.iter().find(|now| now.id == id)?;
            let (segment, time_s) = (keyframe.segment, keyframe.time_s);
            Some(KeyframeMove { segment, time_s, before: keyframe.pose, after: now.pose })
        };
        let moves: Vec<KeyframeMove> = own.filter_map(moved).collect();
        file.set_path(new, &corrected_path(&other.path_of(old)?, &moves))?;
        file.set_losses(new, &other.losses_of(old)?)?;
    }
    Ok((file, Added { merged, mosaic_m, warning }))
}

/// The sessions of another map that this one has not. Fails if there are none, or if the maps are
/// of other cameras.
fn new_sessions(
    (file, map): (&mut MapFile, &GroundMap),
    (other, added): (&mut MapFile, &GroundMap),
    arguments: &MergeArguments,
) -> Result<Vec<Session>> {
    let cameras = file.mounted_cameras()?;
    let is_here = |there: &MountedCamera| cameras.iter().any(|here| here.camera == there.camera);
    if !other.mounted_cameras()?.iter().all(is_here) {
        return Err(Error::input(format!(
            "{} was made with another camera than {}; only maps of the same cameras, each calibrated once, can be joined",
            other.path().display(),
            arguments.maps[0].display()
        )));
    }
    let there = sessions_there(file, map, other, added)?;
    let all = other.sessions()?;
    let path = other.path();
    if !there.is_empty() && there.len() == all.len() {
        return Err(Error::input(format!(
            "every session of {} is in {} already; there is nothing to join",
            path.display(),
            before_it(arguments)
        )));
    }
    if !there.is_empty() && !arguments.quiet {
        let sources: Vec<String> = there.iter().map(|session| console::source(&session.source)).collect();
        console::note(&format!(
            "{} of {} is in {} already, and is left out",
            sources.join(", "),
            console::name(path),
            before_it(arguments)
        ));
    }
    Ok(all.into_iter().filter(|session| !there.contains(session)).collect())
}

/// Begins these sessions of another map, which get the next free numbers, and renumbers what the
/// map has of them. Returns the old and the new numbers.
fn renumbered(file: &mut MapFile, sessions: Vec<Session>, added: &mut GroundMap) -> Result<Vec<(u32, u32)>> {
    let begin = |session: Session| Ok((session.id, begun(file, &session, added)?));
    let numbers = sessions.into_iter().map(begin).collect::<Result<Vec<(u32, u32)>>>()?;
    let new_of = |old: u32| numbers.iter().find(|(number, _)| *number == old).map(|(_, new)| *new);
    for (old, mounted) in std::mem::take(&mut added.other_cameras) {
        added.other_cameras.extend(new_of(old).map(|new| (new, mounted)));
    }
    for keyframe in &mut added.keyframes {
        keyframe.session = new_of(keyframe.session).unwrap_or(keyframe.session);
    }
    for (old, mask) in std::mem::take(&mut added.masks) {
        let Some(new) = new_of(old) else { continue };
        file.set_mask(new, Some(&mask))?;
        added.masks.insert(new, mask);
    }
    Ok(numbers)
}

/// Begins a session of another map, with its camera and mount, and as its robot's where the map
/// has not a part of it already.
fn begun(file: &mut MapFile, session: &Session, added: &GroundMap) -> Result<u32> {
    let (camera, rig) = (added.camera_of(session.id).clone(), *added.rig_of(session.id));
    let mounted = MountedCamera { camera, rig };
    let here = file.sessions()?;
    match &session.origin {
        Some(origin) if here.iter().all(|known| known.origin.as_ref() != Some(origin)) => {
            file.begin_session_of(origin, &session.source, &mounted)
        }
        _ => file.begin_session_with(&session.source, &mounted),
    }
}

/// What a map is joined to, in a sentence.
fn before_it(arguments: &MergeArguments) -> String {
    match arguments.maps.as_slice() {
        [first, _] => console::name(first),
        _ => "the maps before it".to_owned(),
    }
}

/// The sessions of the other map that the map has already: of the same source and robot, with all
/// of their keyframes.
fn sessions_there(
    file: &mut MapFile,
    map: &GroundMap,
    other: &mut MapFile,
    added: &GroundMap,
) -> Result<Vec<Session>> {
    let here = file.sessions()?;
    let mut there = Vec::new();
    for session in other.sessions()? {
        let own: Vec<&MapKeyframe> = of_session(added, session.id).collect();
        let is_same = |known: &&Session| known.source == session.source && known.origin == session.origin;
        for known in here.iter().filter(is_same) {
            if !own.is_empty() && has_all(file, map, known.id, other, &own)? {
                there.push(session);
                break;
            }
        }
    }
    Ok(there)
}

fn of_session(map: &GroundMap, session: u32) -> impl Iterator<Item = &MapKeyframe> {
    map.keyframes.iter().filter(move |keyframe| keyframe.session == session)
}

/// Heights within this fraction are of the same run: optimisation moves them by less, and less than
/// this does not bend a map.
const SAME_HEIGHT: f64 = 0.005;

/// Whether a session of the map has all these keyframes of the other one. A recording that is run
/// again has frames of the same numbers and times: the heights, which differ where it was given
/// another, and the first and the last image are compared, too.
fn has_all(
    file: &mut MapFile,
    map: &GroundMap,
    session: u32,
    other: &mut MapFile,
    own: &[&MapKeyframe],
) -> Result<bool> {
    let equal = |one: &MapKeyframe| {
        of_session(map, session).find(|known| {
            // What was joined before has the pose in its own map as that of its odometry.
            let height_m = known.odometry_pose.height_m;
            known.frame == one.frame
                && known.time_s.to_bits() == one.time_s.to_bits()
                && [one.odometry_pose.height_m, one.pose.height_m]
                    .iter()
                    .any(|own_m| (own_m / height_m - 1.0).abs() < SAME_HEIGHT)
        })
    };
    let Some(known) = own.iter().map(|one| equal(one)).collect::<Option<Vec<_>>>() else { return Ok(false) };
    for at in [0, own.len() - 1] {
        if file.load(known[at].id)? != other.load(own[at].id)? {
            return Ok(false);
        }
    }
    Ok(true)
}

/// What the ground of a map is recognised by, before another one is joined to it.
struct KnownPlaces {
    index: PlaceIndex,
}

impl KnownPlaces {
    fn new(map: &GroundMap) -> Self {
        let mut index = PlaceIndex::new(&PlacesConfig::new(&map.camera, map.rig.first_pose().height_m));
        map.keyframes.iter().for_each(|keyframe| index.insert(keyframe.id, &keyframe.signature));
        Self { index }
    }

    /// Metres of the map over metres of another one, by those of the other one's keyframes that
    /// closed loops; `None` if no place shows a scale. The signatures are by the metres of the
    /// other map, and the loops are by those of this one.
    fn scale_of(
        &self,
        added: &[MapKeyframe],
        beginning: KeyframeId,
        closures: &[LoopClosure],
    ) -> Option<SessionScale> {
        let is_closed = |keyframe: &&MapKeyframe| {
            closures.iter().any(|closure| closure.edge.from.0 == beginning.0 + keyframe.id.0)
        };
        let places = added.iter().filter(is_closed).filter_map(|keyframe| {
            let place = self.index.query(&keyframe.signature, 1).into_iter().find(|place| place.is_sure())?;
            PlaceScale::new(place.motion.w, place.ln_scale_deviation)
        });
        SessionScale::of(&places.collect::<Vec<_>>())
    }
}

/// The markers of both maps, numbered through: those of two families or sizes are never the same.
#[derive(Default)]
struct MarkerNumbers {
    /// Family, side in nanometres and printed number, by the number here.
    known: Vec<(String, i64, u32)>,
}

impl MarkerNumbers {
    fn of_all(&mut self, markers: Vec<MapMarker>) -> Vec<PlacedSighting> {
        let mut number = |MapMarker { family, size_m, mut placed, .. }: MapMarker| {
            let known = (family, (size_m * 1e9).round() as i64, placed.sighting.number);
            let at = self.known.iter().position(|other| *other == known).unwrap_or_else(|| {
                self.known.push(known);
                self.known.len() - 1
            });
            placed.sighting.number = at as u32;
            placed
        };
        markers.into_iter().map(&mut number).collect()
    }

    /// Family, side in metres, and the sighting with the printed number.
    fn as_printed(&self, placed: &PlacedSighting) -> (&str, f64, PlacedSighting) {
        let (family, side_nm, number) = &self.known[placed.sighting.number as usize];
        let sighting = MarkerSighting { number: *number, ..placed.sighting };
        (family, 1e-9 * *side_nm as f64, PlacedSighting { sighting, ..*placed })
    }
}

/// The growing joined map: images are copied from the other map unchanged.
struct Joined {
    file: MapFile,
    other: MapFile,
    beginning: u64,
}

impl KeyframeImages for Joined {
    fn load(&mut self, keyframe: KeyframeId) -> Result<KeyframeImage> {
        self.file.load(keyframe)
    }
}

impl KeyframeStore for Joined {
    fn keep(&mut self, keyframe: &MapKeyframe, _: KeyframeImage, ties: &[MapEdge]) -> Result<()> {
        if interrupt::asked() {
            return Err(Error::input("interrupted; nothing was written"));
        }
        let there = KeyframeId(keyframe.id.0 - self.beginning);
        self.file.add_keyframe_of(keyframe, &self.other, there, ties)
    }

    fn add_edge(&mut self, edge: &MapEdge) -> Result<()> {
        self.file.add_edges(std::slice::from_ref(edge))
    }
}
