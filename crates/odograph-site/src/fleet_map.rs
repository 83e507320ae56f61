//! The map that is made of the records: its file, and the mapper of all robots.

use crate::protocol::{MapFromOdom, SessionDescription};
use crate::record::Record;
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::fixed_pattern::{FixedPattern, ImageMask};
use odograph::ground_map::{
    GroundMap, KeyframeImage, KeyframeImages, KeyframeStore, MapKeyframe, MountedCamera,
};
use odograph::image::GrayImage;
use odograph::keyframe::{EdgeKind, KeyframeId, MapEdge};
use odograph::odometry::{NewKeyframe, OdometryConfig};
use odograph::slam::{FleetMapper, SessionScale};
use odograph_map::{MapClaim, MapFile, SessionOrigin, StoredImage};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// A session of the map.
#[derive(Debug, Clone)]
pub struct MappedSession {
    /// Its number in the map.
    pub session: u32,
    /// Ids in the map by the numbers that the robot gave.
    keyframes: BTreeMap<u64, KeyframeId>,
    camera: Camera,
}

impl MappedSession {
    /// Number of its last keyframe in the map.
    pub fn last(&self) -> Option<u64> {
        self.keyframes.keys().next_back().copied()
    }
}

/// A map and its mapper. There is none before the first session.
#[derive(Debug)]
pub struct FleetMap {
    store: MapStore,
    mapper: FleetMapper,
    sessions: BTreeMap<SessionOrigin, MappedSession>,
    /// What is static in the images of the newest sessions, by session.
    fixed: BTreeMap<u32, FixedPattern>,
}

/// Sessions whose static regions are learned at a time, a megabyte or two each: more than there are
/// robots in a hall. A session beyond these learns anew from what the map knows.
const LEARNING: usize = 64;

impl FleetMap {
    /// Opens the map of a site. `None` if there is none yet.
    pub fn open(claim: &MapClaim) -> Result<Option<Self>> {
        if !MapFile::is_there(claim.path()) {
            return Ok(None);
        }
        let file = MapFile::open_claimed(claim.clone())?;
        let map = file.map()?;
        let mut sessions = BTreeMap::new();
        for session in file.sessions()? {
            let Some(origin) = session.origin else { continue };
            let mut keyframes = BTreeMap::new();
            for keyframe in map.keyframes.iter().filter(|keyframe| keyframe.session == session.id) {
                if let Some(number) = file.number_of(keyframe.id)? {
                    keyframes.insert(number, keyframe.id);
                }
            }
            let camera = map.camera_of(session.id).clone();
            sessions.insert(origin, MappedSession { session: session.id, keyframes, camera });
        }
        let mapper = FleetMapper::new(map, &OdometryConfig::default());
        Ok(Some(Self { store: MapStore { file, waiting: None }, mapper, sessions, fixed: BTreeMap::new() }))
    }

    /// Makes the map of a site for its first session.
    pub fn create(claim: &MapClaim, first: &SessionDescription) -> Result<Self> {
        let file = MapFile::create_claimed(claim.clone(), &first.camera, &first.rig)?;
        let mapper = FleetMapper::new(file.map()?, &OdometryConfig::default());
        let (sessions, fixed) = (BTreeMap::new(), BTreeMap::new());
        Ok(Self { store: MapStore { file, waiting: None }, mapper, sessions, fixed })
    }

    /// A session of the map; `None` if the map has nothing of it.
    pub fn session(&self, origin: &SessionOrigin) -> Option<&MappedSession> {
        self.sessions.get(origin)
    }

    /// Adds a record of a session, unless the map has it. Fails if the map cannot be written.
    pub fn add(&mut self, description: &SessionDescription, record: Record) -> Result<()> {
        let origin = description.origin()?;
        let Record { head, image } = record;
        let mapped = self.begin(&origin, description)?;
        let (session, camera) = (mapped.session, mapped.camera.clone());
        let own = self.mapper.map().keyframes.last().map_or(0, |last| last.id.0 + 1);
        let id = KeyframeId(self.store.file.next_keyframe()?.0.max(own));
        let known = |number: u64| match self.sessions.get(&origin)?.keyframes.get(&number) {
            Some(known) => Some(*known),
            None => (head.keyframe.is_some() && number == head.number).then_some(id),
        };
        let edges: Vec<MapEdge> = head.edges.iter().filter_map(|edge| edge.edge(known)).collect();
        let (Some(keyframe), Some(image)) = (&head.keyframe, image) else {
            return self.mapper.add_edges(&edges, &mut self.store);
        };
        if self.sessions.get(&origin).is_some_and(|mapped| mapped.keyframes.contains_key(&head.number)) {
            return Ok(());
        }
        let picture = image
            .decode((camera.width(), camera.height()))
            .map_err(|why| Error::input(format!("the image of keyframe {} {why}", head.number)))?;
        let mask = self.mask(&origin, session, &picture.gray);
        let (frame, segment, time_s) = keyframe.place_in_source();
        let new = NewKeyframe {
            id,
            frame,
            time_s,
            segment,
            pose: keyframe.pose(),
            covariance: keyframe.covariance(),
            systematic: nalgebra::Matrix6::zeros(),
            tie: None,
            image: picture.gray,
            mask: mask.clone(),
            ground: None,
        };
        self.store.waiting = Some((head.number, image));
        let is_known = self.mapper.map().masks.get(&session) == mask.as_ref();
        self.mapper.add(new, session, &edges, picture.color, &mut self.store)?;
        if !is_known {
            self.store.file.set_mask(session, mask.as_deref())?;
        }
        if let Some(mapped) = self.sessions.get_mut(&origin) {
            mapped.keyframes.insert(head.number, id);
        }
        Ok(())
    }

    /// What of a session's images is not ground, the next of which is given. A record does not say
    /// it; the robot itself may learn it later. Until that is clear, it is what was not ground in
    /// the robot's session before.
    fn mask(&mut self, origin: &SessionOrigin, session: u32, image: &GrayImage) -> Option<Arc<ImageMask>> {
        while self.fixed.len() > LEARNING {
            self.fixed.pop_first();
        }
        let masks = &self.mapper.map().masks;
        let begin = || {
            let own = self.sessions.iter().filter(|(other, _)| other.robot == origin.robot);
            let own = own.map(|(_, mapped)| mapped.session).filter(|other| *other <= session);
            let newest =
                own.filter_map(|session| Some((session, masks.get(&session)?))).max_by_key(|own| own.0);
            let fixed = FixedPattern::new((image.width(), image.height()));
            let fits = |mask: &Arc<ImageMask>| mask.size() == (image.width(), image.height());
            match newest.map(|(_, mask)| mask).filter(|mask| fits(mask)) {
                Some(mask) => fixed.with_known(mask),
                None => fixed,
            }
        };
        let fixed = self.fixed.entry(session).or_insert_with(begin);
        fixed.look(image);
        fixed.mask().cloned()
    }

    /// The session in the map, which is begun where it is not there.
    fn begin(&mut self, origin: &SessionOrigin, description: &SessionDescription) -> Result<&MappedSession> {
        if !self.sessions.contains_key(origin) {
            // The map stores images corrected to a global shutter.
            let camera = description.camera.clone().with_readout_s(None)?;
            let mounted = MountedCamera { camera: camera.clone(), rig: description.rig };
            let session = self.store.file.begin_session_of(origin, &description.source, &mounted)?;
            self.mapper.begin_session(session, &mounted);
            let mapped = MappedSession { session, keyframes: BTreeMap::new(), camera };
            self.sessions.insert(origin.clone(), mapped);
        }
        self.sessions.get(origin).ok_or_else(|| Error::output("a session was not begun"))
    }

    /// Removes everything of some sessions from the map. Returns whether there was anything.
    pub fn remove(self, gone: impl Fn(&SessionOrigin) -> bool) -> Result<(Self, bool)> {
        let Self { mut store, mut mapper, mut sessions, mut fixed } = self;
        let mut numbers = BTreeSet::new();
        let mut keyframes = Vec::new();
        for (_, mapped) in sessions.iter_mut().filter(|(origin, _)| gone(origin)) {
            numbers.insert(mapped.session);
            keyframes.extend(std::mem::take(&mut mapped.keyframes).into_values());
        }
        if !keyframes.is_empty() {
            store.file.remove_keyframes(&keyframes, &[])?;
        }
        // A keyframe that could not be stored is in the mapper alone.
        for session in &numbers {
            fixed.remove(session);
            if mapper.map().masks.contains_key(session) {
                store.file.set_mask(*session, None)?;
            }
        }
        let any = mapper.map().keyframes.iter().any(|keyframe| numbers.contains(&keyframe.session));
        if any {
            mapper = mapper.without(&numbers);
        }
        Ok((Self { store, mapper, sessions, fixed }, any))
    }

    /// Scale of a session relative to the map.
    pub fn scale(&self, mapped: &MappedSession) -> Option<SessionScale> {
        self.mapper.scale(mapped.session)
    }

    /// Where the odometry frame of a session lies in the map.
    pub fn placement(&self, mapped: &MappedSession) -> Option<MapFromOdom> {
        let placement = self.mapper.placement(mapped.session)?;
        let transform = placement.map_from_odometry;
        let number = mapped.keyframes.iter().rev().find(|(_, id)| **id == placement.keyframe)?;
        Some(MapFromOdom {
            x_m: transform.x_m,
            y_m: transform.y_m,
            heading_rad: transform.heading_rad,
            scale: transform.scale,
            covariance: std::array::from_fn(|row| {
                std::array::from_fn(|column| placement.covariance[(row, column)])
            }),
            keyframe: *number.0,
        })
    }

    /// The map.
    pub fn map(&self) -> &GroundMap {
        self.mapper.map()
    }

    /// The loops between different sessions.
    pub fn shared_loops(&self) -> impl Iterator<Item = (&MapKeyframe, &MapKeyframe)> {
        let map = self.mapper.map();
        let keyframe = |id: KeyframeId| {
            map.keyframes.binary_search_by_key(&id, |keyframe| keyframe.id).ok().map(|at| &map.keyframes[at])
        };
        let loops = map.edges.iter().filter(|edge| edge.kind == EdgeKind::Loop);
        loops
            .filter_map(move |edge| Some((keyframe(edge.from)?, keyframe(edge.to)?)))
            .filter(|(one, other)| one.session != other.session)
    }

    /// Optimises the map and writes the poses.
    pub fn settle(&mut self) -> Result<()> {
        self.mapper.finish();
        let keyframes = &self.mapper.map().keyframes;
        let poses: Vec<_> =
            keyframes.iter().map(|keyframe| (keyframe.id, keyframe.pose, keyframe.covariance)).collect();
        self.store.file.set_poses(&poses)
    }

    /// Renders the mosaic of what is connected to the first keyframe: where the rest lies is not
    /// known. `keep_going` is asked in between.
    pub fn render(&mut self, keep_going: &mut dyn FnMut() -> bool) -> Result<bool> {
        let sessions = self.sessions.values().map(|mapped| mapped.session);
        let connected: BTreeSet<u32> =
            sessions.filter(|session| self.mapper.is_connected(*session)).collect();
        let mut part = self.mapper.map().clone();
        part.keyframes.retain(|keyframe| connected.contains(&keyframe.session));
        self.store.file.render_mosaic_of(&part, None, &mut |_| keep_going())
    }

    /// Closes the file.
    pub fn close(self) -> Result<()> {
        self.store.file.close()
    }
}

/// The map file as the store of the mapper.
#[derive(Debug)]
struct MapStore {
    file: MapFile,
    /// Number and image of the keyframe that is being added, as its robot has them.
    waiting: Option<(u64, StoredImage)>,
}

impl KeyframeImages for MapStore {
    fn load(&mut self, keyframe: KeyframeId) -> Result<KeyframeImage> {
        self.file.load(keyframe)
    }
}

impl KeyframeStore for MapStore {
    fn keep(&mut self, keyframe: &MapKeyframe, _: KeyframeImage, ties: &[MapEdge]) -> Result<()> {
        match self.waiting.take() {
            Some((number, image)) => self.file.add_numbered_keyframe(keyframe, number, &image, ties),
            None => Err(Error::output("a keyframe has no record")),
        }
    }

    fn add_edge(&mut self, edge: &MapEdge) -> Result<()> {
        self.file.add_edges(std::slice::from_ref(edge))
    }
}
