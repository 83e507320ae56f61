//! The ground of a run: its cells, and its mosaic with the georeference.

use crate::node::{Delivery, Node};
use crate::topic::Topic;
use odograph::error::Result;
use odograph_live::{Hub, Overview, SeenGrid};
use odograph_session::ros_messages::{self, GroundRaster, MAP};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

const GRID: &str = "/odograph/grid";
/// As image_transport names a compressed topic: its base is `/odograph/mosaic`.
const MOSAIC: &str = "/odograph/mosaic/compressed";
const GEOREFERENCE: &str = "/odograph/mosaic/georeference";
/// As image_transport describes a picture in colour without opacity.
const FORMAT: &str = "rgb8; png compressed bgr8";

/// Largest number of cells: 100 m by 100 m with sides of 5 cm, and a message of 4 MB.
const MOST_CELLS: usize = 1 << 22;
/// Largest number of pixels of the mosaic: a message of some 5 MB.
const MOST_PIXELS: usize = 1 << 22;
/// Shortest interval of grids.
const GRID_EVERY: Duration = Duration::from_secs(2);
/// Shortest interval of mosaics, which are not for control.
const MOSAIC_EVERY: Duration = Duration::from_secs(5);
/// Mean rate of each at most, bytes a second, which a wireless network carries beside images.
const RATE: f64 = 1e6;
/// Interval of looks at the ground.
const STEP: Duration = Duration::from_millis(200);

/// Publishes the ground whenever it has changed, also after a loop closure, and at the end.
#[derive(Debug)]
pub struct GroundPublisher {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    /// Stamp of the newest frame.
    newest_ns: AtomicU64,
    ended: AtomicBool,
    asleep: Mutex<()>,
    ending: Condvar,
}

impl GroundPublisher {
    /// Announces the topics that are wanted; `None` if there are none.
    pub fn new(node: &Node, hub: &Arc<Hub>, has_grid: bool, has_mosaic: bool) -> Result<Option<Self>> {
        let latched = |name, type_name| Topic::new(node, name, type_name, Delivery::Latched, 1);
        let mut layers: Vec<Layer> = Vec::new();
        if has_grid {
            let topic = latched(GRID, "nav_msgs/msg/OccupancyGrid")?;
            layers.push(Layer::new(GRID_EVERY, Grid { topic, grid: SeenGrid::new(MOST_CELLS) }));
        }
        if has_mosaic {
            let picture = latched(MOSAIC, "sensor_msgs/msg/CompressedImage")?;
            let georeference = latched(GEOREFERENCE, "nav_msgs/msg/MapMetaData")?;
            let overview = Overview::new(MOST_PIXELS);
            layers.push(Layer::new(MOSAIC_EVERY, Mosaic { picture, georeference, overview }));
        }
        if layers.is_empty() {
            return Ok(None);
        }
        let shared = Arc::new(Shared::default());
        let (of_thread, hub) = (Arc::clone(&shared), Arc::clone(hub));
        let thread = thread::spawn(move || {
            while !of_thread.ended.load(Ordering::Relaxed) {
                layers
                    .iter_mut()
                    .filter(|layer| layer.is_due())
                    .for_each(|layer| layer.look(&hub, &of_thread));
                let asleep = of_thread.asleep.lock().unwrap_or_else(PoisonError::into_inner);
                drop(of_thread.ending.wait_timeout(asleep, STEP));
            }
            // As it was written.
            layers.iter_mut().for_each(|layer| {
                layer.look(&hub, &of_thread);
                layer.published.wait();
            });
        });
        Ok(Some(Self { shared, thread: Some(thread) }))
    }

    /// Takes the stamp of the newest frame, nanoseconds.
    pub fn set_time(&self, time_ns: u64) {
        self.shared.newest_ns.store(time_ns, Ordering::Relaxed);
    }
}

impl Drop for GroundPublisher {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        self.shared.ending.notify_all();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A part of the ground, and when it may be published again.
struct Layer {
    published: Box<dyn Published>,
    every: Duration,
    due: Option<Instant>,
}

impl Layer {
    fn new(every: Duration, published: impl Published + 'static) -> Self {
        Self { published: Box::new(published), every, due: None }
    }

    fn is_due(&self) -> bool {
        self.due.is_none_or(|due| Instant::now() >= due)
    }

    fn look(&mut self, hub: &Hub, shared: &Shared) {
        let time_ns = shared.newest_ns.load(Ordering::Relaxed);
        if let Some(bytes) = self.published.publish(hub, time_ns) {
            let pause = self.every.max(Duration::from_secs_f64(bytes as f64 / RATE));
            self.due = Some(Instant::now() + pause);
        }
    }
}

/// What is published of the ground.
trait Published: Send {
    /// Publishes it if it has changed, and returns the number of bytes.
    fn publish(&mut self, hub: &Hub, time_ns: u64) -> Option<usize>;
    /// Waits until those who listen have it, for a moment at most.
    fn wait(&self);
}

struct Grid {
    topic: Topic,
    grid: SeenGrid,
}

impl Published for Grid {
    fn publish(&mut self, hub: &Hub, time_ns: u64) -> Option<usize> {
        let cells = self.grid.update(hub.ground()).then(|| self.grid.cells())??;
        let raster = GroundRaster {
            resolution_m: cells.cell_m,
            width: cells.width(),
            height: cells.height(),
            corner_m: cells.corner_m(),
        };
        self.topic.wait();
        self.topic.send(ros_messages::occupancy_grid(time_ns, MAP, &raster, &cells.seen));
        Some(cells.seen.len())
    }

    fn wait(&self) {
        self.topic.wait();
    }
}

struct Mosaic {
    picture: Topic,
    georeference: Topic,
    overview: Overview,
}

impl Published for Mosaic {
    fn publish(&mut self, hub: &Hub, time_ns: u64) -> Option<usize> {
        let picture = self.overview.update(hub.ground()).then(|| self.overview.picture())??;
        let raster = GroundRaster {
            resolution_m: picture.placement.metres_per_pixel,
            width: picture.width,
            height: picture.height,
            corner_m: picture.corner_m(),
        };
        let png = picture.rgb_png()?;
        self.wait();
        self.georeference.send(ros_messages::map_meta_data(time_ns, &raster));
        self.picture.send(ros_messages::compressed_image(time_ns, MAP, FORMAT, &png));
        Some(png.len())
    }

    fn wait(&self) {
        self.georeference.wait();
        self.picture.wait();
    }
}
