//! Keyframes: images whose corners lie on the ground as metric points.

use crate::camera::Camera;
use crate::detection::{DetectionConfig, detect};
use crate::flow::{Template, Warp};
use crate::geometry::{GroundPoint, GroundPose, Pixel, Ray};
use crate::image::Pyramid;
use crate::mapping::KeyframeId;
use crate::motion::{CoarseRegistration, GroundView};
use nalgebra::{Matrix2, Matrix6, Vector2};
use std::collections::VecDeque;

/// Corners this near the border cannot carry a full template with its gradients.
const MARGIN_PX: usize = 9;

/// Three points this far around the centre of a corner, a third of a turn apart, show where and in which shape its patch is expected, pixels. In their
/// mean a curvature of the warp (a lens is never straight) shifts as much as in the mean of the whole patch, of which the samples are
/// (16² − 1) / 12 px² from the middle along either side: their squared distance is twice that of both.
const RING_PX: f64 = 6.519_202_405_202_649;

/// Of the ring's points, (right, down) in units of its radius.
const RING: [(f64, f64); 3] = [(1.0, 0.0), (-0.5, 0.866_025_403_784_438_6), (-0.5, -0.866_025_403_784_438_6)];

/// An image in use as the reference, with its corners prepared for being found again.
#[derive(Debug)]
pub struct Keyframe {
    /// Its number; one that has not been taken into use yet has none.
    pub id: Option<KeyframeId>,
    pub pyramid: Pyramid,
    pub pose: GroundPose,
    /// Of the pose against the start of the run, (x, y, heading, height, roll, pitch).
    pub covariance: Matrix6<f64>,
    pub corners: Vec<KeyCorner>,
    /// How many corners it began with.
    pub corners_at_first: usize,
    /// Where the corners are, enough to prepare the keyframe again.
    places: Vec<(usize, usize)>,
    /// The ground as the keyframe saw it, for coarse registration; made when it is first needed.
    view: Option<GroundView>,
}

/// A corner of a keyframe.
#[derive(Debug)]
pub struct KeyCorner {
    pub template: Template,
    /// Where its centre lies on the ground.
    pub ground: GroundPoint,
    /// Where the points of the ring around the centre lie.
    ring: [GroundPoint; 3],
    /// How it was last found.
    pub seen: Warp,
}

impl KeyCorner {
    /// Where and in which shape the corner is expected by a camera at `pose`; `None` where it would be out of sight.
    pub fn warp(&self, camera: &Camera, pose: &Pose) -> Option<PatchWarp> {
        let centre = pose.pixel(camera, self.ground)?;
        let mut mean = Vector2::zeros();
        let mut linear = Matrix2::zeros();
        for (point, (right, down)) in self.ring.iter().zip(RING) {
            let pixel = pose.pixel(camera, *point)?;
            let from_centre = Vector2::new(pixel.x - centre.x, pixel.y - centre.y);
            mean += from_centre / 3.0;
            // Least squares over the ring.
            linear += from_centre * Vector2::new(right, down).transpose() * (2.0 / (3.0 * RING_PX));
        }
        let position = Pixel::new(centre.x + mean.x, centre.y + mean.y);
        Some(PatchWarp { warp: Warp { position, linear }, bend: mean })
    }
}

/// How the patch of a corner is expected.
#[derive(Debug, Clone, Copy)]
pub struct PatchWarp {
    /// Of the patch as a whole.
    pub warp: Warp,
    /// How far the patch as a whole is from where its centre is, pixels: Lucas–Kanade finds the whole patch, and what lies on the ground is its
    /// centre. Left out, a lens that bends lines makes every way as much longer as its curvature changes along it.
    pub bend: Vector2<f64>,
}

/// A pose with its rotation worked out once for many points.
pub struct Pose {
    pose: GroundPose,
    camera_from_world: nalgebra::Matrix3<f64>,
}

impl Pose {
    pub fn new(pose: GroundPose) -> Self {
        Self { pose, camera_from_world: pose.world_from_camera_rotation().transpose() }
    }

    pub fn pixel(&self, camera: &Camera, point: GroundPoint) -> Option<Pixel> {
        let from_camera =
            nalgebra::Vector3::new(point.x_m - self.pose.x_m, point.y_m - self.pose.y_m, -self.pose.height_m);
        let p = self.camera_from_world * from_camera;
        (p.z > 1e-9).then(|| camera.pixel_from_ray(crate::geometry::Ray::new(p.x / p.z, p.y / p.z)))?
    }
}

/// The rays of a pixel and of the ring around it: the others by one step of Newton's method from where the derivative at the first puts them,
/// exact to far less than a thousandth of a pixel.
fn rays_about(camera: &Camera, pixel: Pixel) -> Option<(Ray, [Ray; 3])> {
    let ray = camera.ray_from_pixel(pixel)?;
    let (_, pixel_by_ray) = camera.pixel_and_derivative(ray)?;
    let ray_by_pixel = pixel_by_ray.try_inverse()?;
    let beside = |(right, down): (f64, f64)| {
        let offset = RING_PX * Vector2::new(right, down);
        let guess = ray_by_pixel * offset;
        let guess = Ray::new(ray.x + guess.x, ray.y + guess.y);
        let seen = camera.pixel_from_ray(guess)?;
        let left = ray_by_pixel * Vector2::new(pixel.x + offset.x - seen.x, pixel.y + offset.y - seen.y);
        Some(Ray::new(guess.x + left.x, guess.y + left.y))
    };
    Some((ray, [beside(RING[0])?, beside(RING[1])?, beside(RING[2])?]))
}

/// [`GroundPose::ground_from_ray`] with the rotation worked out once for many rays.
pub struct GroundFromRay<'a> {
    pose: &'a GroundPose,
    world_from_camera: nalgebra::Matrix3<f64>,
}

impl<'a> GroundFromRay<'a> {
    pub fn new(pose: &'a GroundPose) -> Self {
        Self { pose, world_from_camera: pose.world_from_camera_rotation() }
    }

    pub fn of(&self, ray: Ray) -> Option<GroundPoint> {
        let direction = self.world_from_camera * ray.vector();
        (direction.z < -1e-9).then(|| {
            let reach = -self.pose.height_m / direction.z;
            GroundPoint::new(self.pose.x_m + reach * direction.x, self.pose.y_m + reach * direction.y)
        })
    }
}

impl Keyframe {
    /// Makes a keyframe of an image at a known pose: finds its corners and lays them on the ground.
    pub fn new(
        pyramid: Pyramid,
        pose: GroundPose,
        covariance: Matrix6<f64>,
        camera: &Camera,
        detection: &DetectionConfig,
    ) -> Self {
        let places = detect(pyramid.base(), detection, MARGIN_PX).iter().map(|c| (c.x, c.y)).collect();
        Self::prepare(
            KeyframeRecord { id: None, pyramid, pose, covariance, places, view: None, reachable: true },
            camera,
        )
    }

    fn prepare(record: KeyframeRecord, camera: &Camera) -> Self {
        let KeyframeRecord { id, pyramid, pose, covariance, places, view, .. } = record;
        let ground_from_ray = GroundFromRay::new(&pose);
        let corner = |&place: &(usize, usize)| {
            let template = Template::of_finest_level(&pyramid, place)?;
            let centre = template.centre();
            let (ray, [first, second, third]) = rays_about(camera, centre)?;
            let on_ground = |ray| ground_from_ray.of(ray);
            Some(KeyCorner {
                ground: on_ground(ray)?,
                ring: [on_ground(first)?, on_ground(second)?, on_ground(third)?],
                seen: Warp::translation(centre),
                template,
            })
        };
        let corners: Vec<KeyCorner> = places.iter().filter_map(corner).collect();
        Self { id, corners_at_first: corners.len(), corners, pyramid, pose, covariance, places, view }
    }

    /// Makes the view for coarse registration, where there is none yet.
    pub fn prepare_view(&mut self, registration: &CoarseRegistration) {
        if self.view.is_none() {
            self.view = registration.view(&self.pyramid, &self.pose);
        }
    }

    /// The view that [`Keyframe::prepare_view`] made; none where it could not be made.
    pub fn view(&self) -> Option<&GroundView> {
        self.view.as_ref()
    }

    /// Keeps only the given corners, with where they were seen.
    pub fn keep_only(&mut self, seen: impl Iterator<Item = (usize, Warp)>) {
        let mut kept = vec![None; self.corners.len()];
        seen.for_each(|(corner, warp)| kept[corner] = Some(warp));
        let mut index = 0;
        self.corners.retain_mut(|corner| {
            let warp = kept[index];
            index += 1;
            if let Some(warp) = warp {
                corner.seen = warp;
            }
            warp.is_some()
        });
    }

    /// What is kept of a keyframe that is no longer in use.
    pub fn retire(self) -> KeyframeRecord {
        let Self { id, pyramid, pose, covariance, places, view, .. } = self;
        KeyframeRecord { id, pyramid, pose, covariance, places, view, reachable: true }
    }
}

/// A keyframe without its templates: a tenth of the memory.
#[derive(Debug)]
pub struct KeyframeRecord {
    id: Option<KeyframeId>,
    pyramid: Pyramid,
    pose: GroundPose,
    covariance: Matrix6<f64>,
    places: Vec<(usize, usize)>,
    view: Option<GroundView>,
    /// Whether its pose is connected with the present one by measurement.
    reachable: bool,
}

/// The last keyframes, to be taken up again when the camera comes back to them.
#[derive(Debug)]
pub struct KeyframeMemory {
    records: VecDeque<KeyframeRecord>,
    most: usize,
}

impl KeyframeMemory {
    pub fn new(most: usize) -> Self {
        Self { records: VecDeque::new(), most }
    }

    pub fn remember(&mut self, record: KeyframeRecord) {
        self.records.push_back(record);
        while self.records.len() > self.most {
            self.records.pop_front();
        }
    }

    /// Takes out the keyframe of which a camera at `pose` sees most, if that is at least `least` of its image.
    pub fn take_best(&mut self, camera: &Camera, pose: &GroundPose, least: f64) -> Option<Keyframe> {
        let seen = Pose::new(*pose);
        let rays = grid_rays(camera);
        let overlap = |record: &KeyframeRecord| overlap(record, &rays, camera, &seen);
        let best = self
            .records
            .iter()
            .enumerate()
            .map(|(i, record)| (overlap(record), i))
            .filter(|(overlap, _)| *overlap >= least)
            .max_by(|a, b| a.0.total_cmp(&b.0))?;
        let record = self.records.remove(best.1)?;
        Some(Keyframe::prepare(record, camera))
    }

    /// Puts a keyframe back that was taken out in vain.
    pub fn put_back(&mut self, keyframe: Keyframe) {
        self.remember(keyframe.retire());
    }

    /// Takes out the keyframe with that index.
    pub fn take(&mut self, index: usize, camera: &Camera) -> Option<Keyframe> {
        self.records.remove(index).map(|record| Keyframe::prepare(record, camera))
    }

    /// Puts a keyframe back where [`KeyframeMemory::take`] took it from.
    pub fn put_back_at(&mut self, index: usize, keyframe: Keyframe) {
        self.records.insert(index.min(self.records.len()), keyframe.retire());
    }

    /// A new segment begins: what is remembered is no longer connected with the present by measurement.
    pub fn close_segment(&mut self) {
        self.records.iter_mut().for_each(|record| record.reachable = false);
    }

    /// How many keyframes are connected with the present by measurement.
    pub fn reachable(&self) -> usize {
        self.records.iter().filter(|record| record.reachable).count()
    }

    /// The indices of those keyframes, the newest first.
    pub fn newest(&self) -> Vec<usize> {
        (0..self.records.len()).rev().filter(|&index| self.records[index].reachable).collect()
    }

    /// The indices of those keyframes, the nearest to a pose first.
    pub fn nearest(&self, pose: &GroundPose) -> Vec<usize> {
        let away = |index: usize| {
            let other = &self.records[index].pose;
            (other.x_m - pose.x_m).hypot(other.y_m - pose.y_m)
        };
        let mut indices = self.newest();
        indices.sort_by(|&a, &b| away(a).total_cmp(&away(b)));
        indices
    }
}

/// Points of a coarse grid over an image, on a side.
pub const GRID: usize = 8;

/// What the camera sees at the points of a coarse grid over its image.
pub fn grid_rays(camera: &Camera) -> [Option<Ray>; GRID * GRID] {
    let (width, height) = (camera.width() as f64, camera.height() as f64);
    std::array::from_fn(|at| {
        let along = |i: usize, size: f64| (i as f64 + 0.5) / GRID as f64 * size - 0.5;
        camera.ray_from_pixel(Pixel::new(along(at % GRID, width), along(at / GRID, height)))
    })
}

/// The part of a coarse grid over a keyframe's image that a camera at `pose` would have in view.
fn overlap(record: &KeyframeRecord, rays: &[Option<Ray>; GRID * GRID], camera: &Camera, pose: &Pose) -> f64 {
    seen_share(&record.pose, rays, camera, pose)
}

/// The part of a coarse grid over the image of a camera at `at` that a camera at `pose` would have in view.
pub fn seen_share(at: &GroundPose, rays: &[Option<Ray>; GRID * GRID], camera: &Camera, pose: &Pose) -> f64 {
    let ground_from_ray = GroundFromRay::new(at);
    let seen = rays.iter().filter(|ray| {
        let ground = ray.and_then(|ray| ground_from_ray.of(ray));
        let back = ground.and_then(|ground| pose.pixel(camera, ground));
        back.is_some_and(|pixel| camera.contains(pixel, MARGIN_PX as f64))
    });
    seen.count() as f64 / (GRID * GRID) as f64
}
