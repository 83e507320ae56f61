//! Images whose single pixels are mostly noise.

use super::*;

/// Noise of this many gray levels that blurs over neighbouring pixels, on ground of low contrast:
/// what a camera that scales its images up, or filters them in the dark, hands out.
fn noisy(mut image: GrayImage, number: u64, gray: i32) -> GrayImage {
    let mut random = Random::new(1000 + number);
    let (width, height) = (image.width(), image.height());
    let white: Vec<i32> =
        (0..width * height).map(|_| (0..4).map(|_| random.below(3) as i32 - 1).sum()).collect();
    for y in 0..height {
        for x in 0..width {
            let noise = |x: usize, y: usize| white[y % height * width + x % width];
            let blurred: i32 = (0..9).map(|i| noise(x + i % 3, y + i / 3)).sum();
            let sample = &mut image.samples_mut()[y * width + x];
            *sample = (90 + i32::from(*sample) / 4 + gray * blurred / 5).clamp(0, 255) as u8;
        }
    }
    image
}

/// The error at the end of a path, millimetres.
fn follow(odometry: &mut Odometry, world: &World, gray: i32) -> f64 {
    let poses: Vec<_> = drive(0.0, 40).collect();
    let mut last_mm = f64::INFINITY;
    for (number, pose) in poses.iter().enumerate() {
        let image = noisy(world.image(*pose, number as u64), number as u64, gray);
        let frame = odometry.process(image, number as f64 * FRAME_S).unwrap();
        (last_mm, _) = errors(&frame, pose);
        // Tracks are shown in the pixels of the image that came in.
        let is_right = odometry.tracks().iter().any(|track| track.pixel.x > 340.0);
        assert!(frame.tracks == 0 || is_right, "frame {number}");
    }
    last_mm
}

#[test]
fn correlated_noise_is_tracked_at_a_coarser_resolution() {
    let world = World::new("asphalt");
    let mut live = world.odometry();
    let off_mm = follow(&mut live, &world, 4);
    assert!(live.halvings() > 0, "a noise ratio of {}", live.learned.noise_ratio());
    // 0.14 mm where this was written, of 780 mm.
    assert!(off_mm < 0.6, "{off_mm}");
    // Where a later pass begins with it, no frame is tracked at full resolution.
    let halved = EarlierPass { halvings: 1, ..EarlierPass::default() };
    let mut again = world.odometry().with_earlier_pass(&halved);
    let off_mm = follow(&mut again, &world, 4);
    assert!(again.halvings() > 0);
    assert!(off_mm < 0.6, "{off_mm}");
}

#[test]
fn weak_or_white_noise_is_tracked_at_full_resolution() {
    let world = World::new("asphalt");
    let mut odometry = world.odometry();
    follow(&mut odometry, &world, 1);
    assert_eq!(odometry.halvings(), 0);
    let world = World::new("concrete");
    let mut odometry = world.odometry();
    world.run(&mut odometry, &drive(0.0, 20).collect::<Vec<_>>());
    assert_eq!(odometry.halvings(), 0);
}

#[test]
fn masks_and_keyframes_are_handed_out_at_the_size_of_the_images() {
    let world = World::new("asphalt");
    let mut shown = GrayImage::new(640, 480);
    shown.samples_mut().fill(255);
    shown.samples_mut()[640 * 400..].fill(0);
    let halved = EarlierPass { halvings: 1, ..EarlierPass::default() };
    let mut odometry = world.odometry().with_mask(&shown).unwrap().with_earlier_pass(&halved);
    let mask = odometry.mask().expect("a mask");
    assert_eq!(mask.size(), (640, 480));
    assert!(mask.covers(300, 450) && !mask.covers(300, 350));
    // The order of the two does not matter.
    let other = world.odometry().with_earlier_pass(&halved).with_mask(&shown).unwrap();
    assert_eq!(other.mask().map(|mask| mask.size()), Some((640, 480)));
    odometry.record_keyframes();
    let pose = at(0.0, 0.0, 0.0);
    odometry.process(world.image(pose, 0), 0.0).unwrap();
    let events = odometry.take_keyframe_events();
    let [KeyframeEvent::Made(made)] = &events[..] else { panic!("{events:?}") };
    assert_eq!((made.image.width(), made.image.height()), (640, 480));
    assert_eq!(made.mask.as_ref().map(|mask| mask.size()), Some((640, 480)));
    // Half the resolution of the same view, in the same place.
    let (full, half) = (world.image(pose, 0), &made.image);
    let mean_off = |dx: usize| {
        let off = |y: usize, x: usize| f64::from(full.row(y)[x + dx]) - f64::from(half.row(y)[x]);
        (8..392).map(|y| (8..600).map(|x| off(y, x).powi(2)).sum::<f64>()).sum::<f64>()
    };
    assert!(mean_off(0) < 0.8 * mean_off(1));
}
