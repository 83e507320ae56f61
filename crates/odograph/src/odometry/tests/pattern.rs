//! Patterns that the camera adds to its images.

use super::*;

/// Halves the contrast of an image and adds a pattern of blocks of 3x3 pixels: the same in every
/// image.
fn behind_a_dirty_window(mut image: GrayImage, gray: i32) -> GrayImage {
    let width = image.width();
    for (at, sample) in image.samples_mut().iter_mut().enumerate() {
        let block = at % width / 3 + 1000 * (at / width / 3);
        let dirt = Random::new(block as u64).below(2 * gray as usize + 1) as i32 - gray;
        *sample = (64 + i32::from(*sample) / 2 + dirt).clamp(0, 255) as u8;
    }
    image
}

/// Runs over images, 30 a second.
fn process(odometry: &mut Odometry, images: impl Iterator<Item = GrayImage>) -> Vec<FrameEstimate> {
    let take = |(number, image)| odometry.process(image, number as f64 * FRAME_S).unwrap();
    images.enumerate().map(take).collect()
}

#[test]
fn ground_below_a_stronger_pattern_is_followed() {
    let world = World::new("concrete");
    let pose = |number: usize| at(0.012 * number as f64, 0.0, 0.0);
    let images = (0..70).map(|number| behind_a_dirty_window(world.image(pose(number), number as u64), 20));
    let images: Vec<GrayImage> = images.collect();
    let mut live = world.odometry();
    let frames = process(&mut live, images.iter().cloned());
    // The pattern looks like ground until three images have been compared. Then it is found out and
    // learned, and removed from the first keyframe too, so that all is as if it had never been.
    assert!(frames[17..27].iter().all(|frame| frame.estimate.is_none()), "the pattern was followed");
    for (number, frame) in frames.iter().enumerate().skip(40) {
        let (off_mm, _) = errors(frame, &pose(number));
        assert!(off_mm < 2.0, "frame {number}: {off_mm} mm");
    }
    // With the pattern known, from the first frame on.
    let mut again = world
        .odometry()
        .with_earlier_pass(&EarlierPass { correction: live.correction().cloned(), ..EarlierPass::default() });
    let frames = process(&mut again, images.into_iter());
    let off_mm = frames.iter().enumerate().map(|(number, frame)| errors(frame, &pose(number)).0);
    assert!(off_mm.fold(0.0, f64::max) < 2.0);
}

#[test]
fn a_standing_camera_learns_no_pattern() {
    let world = World::new("concrete");
    let person = World::new("carpet");
    let images = (0..90usize).map(|number| {
        let mut image = world.image(at(0.0, 0.0, 0.0), number as u64);
        // The light changes, and a person covers a third of the view on the way through.
        let light = 16 + (number as i32 % 7);
        image
            .samples_mut()
            .iter_mut()
            .for_each(|sample| *sample = (i32::from(*sample) * light / 20).min(255) as u8);
        let cloth = person.image(at(0.0, 0.01 * number as f64, 0.0), 0);
        let left = (8 * number).min(640);
        for y in 0..480 {
            let covered = left.saturating_sub(210)..left;
            let row = y * 640;
            image.samples_mut()[row + covered.start..row + covered.end]
                .copy_from_slice(&cloth.row(y)[covered]);
        }
        image
    });
    let mut odometry = world.odometry();
    process(&mut odometry, images);
    assert!(odometry.correction().is_none());
}

#[test]
fn a_camera_that_vibrates_on_the_spot_learns_no_pattern() {
    let world = World::new("tiles");
    // 5 px at 16.3 Hz: from one look to the next, every eight frames, the phase goes on by a third.
    let shaken = |number: usize| 0.0075 * (2.0 * std::f64::consts::PI * 0.5417 * number as f64).sin();
    let images = (0..150).map(|number| world.image(at(0.0, shaken(number), 0.0), number as u64));
    let mut odometry = world.odometry();
    process(&mut odometry, images);
    assert!(odometry.correction().is_none());
}

#[test]
fn a_camera_that_trembles_by_less_than_a_movement_learns_no_pattern() {
    let world = World::new("tiles");
    // A pixel at frequencies whose phases differ at each look.
    let wave = |number: usize, turns: f64| (std::f64::consts::TAU * turns * number as f64).sin();
    let shaken = |number: usize| at(0.0015 * wave(number, 0.29), 0.0015 * wave(number, 0.36), 0.0);
    let images = (0..250).map(|number| world.image(shaken(number), number as u64));
    let mut odometry = world.odometry();
    process(&mut odometry, images);
    assert!(odometry.correction().is_none());
}

#[test]
fn the_pattern_is_found_where_the_ground_turns_below_it() {
    let world = World::new("concrete");
    // 54°/s.
    let pose = |number: usize| at(0.012 * number as f64, 0.0, 0.0315 * number as f64);
    let images = (0..70).map(|number| behind_a_dirty_window(world.image(pose(number), number as u64), 20));
    let mut odometry = world.odometry();
    process(&mut odometry, images);
    assert!(odometry.correction().is_some());
}
