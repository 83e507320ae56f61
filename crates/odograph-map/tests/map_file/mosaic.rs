//! The mosaic of a map compared with the ground that its keyframes saw.

use crate::ground;
use odograph::camera::Rig;
use odograph::fixed_pattern::ImageMask;
use odograph::geometry::GroundPose;
use odograph::ground_map::KeyframeImage;
use odograph::image::GrayImage;
use odograph::mosaic::MosaicPicture;
use odograph_map::MapFile;
use std::io::Cursor;
use tiff::decoder::{Decoder, DecodingResult};
use tiff::tags::Tag;

/// The mosaic of twelve keyframes with modified images and with the poses of `misplaced`.
fn mosaic(
    change: impl Fn(u64, GrayImage) -> GrayImage,
    misplaced: impl Fn(u64) -> GroundPose,
) -> MosaicPicture {
    let folder = tempfile::tempdir().unwrap();
    let mut map =
        MapFile::create(&folder.path().join("map.gpkg"), &ground::camera(), &Rig::level(0.5)).unwrap();
    for number in 0..12 {
        let mut keyframe = ground::keyframe(number, 0);
        keyframe.pose = misplaced(number);
        let image = KeyframeImage { gray: change(number, ground::image(number).gray), color: None };
        map.add_keyframe(&keyframe, &image, &[]).unwrap();
    }
    map.render_mosaic(Some(0.004), &mut |_| true).unwrap();
    map.mosaic_picture(usize::MAX).unwrap().unwrap()
}

/// Mean brightness of completely visible windows of 16 × 16 pixels.
fn windows(picture: &MosaicPicture) -> Vec<((usize, usize), f64)> {
    let mut found = Vec::new();
    for row in (0..picture.height.saturating_sub(16)).step_by(16) {
        for column in (0..picture.width.saturating_sub(16)).step_by(16) {
            let pixels = (0..256).map(|k| 4 * ((row + k / 16) * picture.width + column + k % 16));
            let pixels: Vec<&[u8]> = pixels.map(|at| &picture.rgba[at..at + 4]).collect();
            if pixels.iter().all(|pixel| pixel[3] == 255) {
                found.push((
                    (column, row),
                    pixels.iter().map(|pixel| f64::from(pixel[0])).sum::<f64>() / 256.0,
                ));
            }
        }
    }
    found
}

#[test]
fn exposure_and_vignetting_are_compensated() {
    let even = mosaic(|_, image| image, ground::pose);
    // Relative exposures from 0.8 to 1.05, and vignetting of 30 % in the corners.
    let uneven = mosaic(
        |number, mut image| {
            let exposure = [1.0, 0.8, 0.95, 0.85, 1.05][number as usize % 5];
            for (k, sample) in image.samples_mut().iter_mut().enumerate() {
                let (x, y) = ((k % 160) as f64 - 79.5, (k / 160) as f64 - 59.5);
                *sample =
                    (f64::from(*sample) * exposure * (1.0 - 0.3 * (x * x + y * y) / 10_000.0)).round() as u8;
            }
            image
        },
        ground::pose,
    );
    assert_eq!((even.width, even.height), (uneven.width, uneven.height));
    let mut ratios: Vec<f64> = windows(&even).iter().zip(windows(&uneven)).map(|(a, b)| b.1 / a.1).collect();
    assert!(ratios.len() > 100, "{}", ratios.len());
    ratios.sort_by(f64::total_cmp);
    let median = ratios[ratios.len() / 2];
    // Uncompensated, the ratios range from 0.6 to 1. The rest is because the vignetting is not
    // exactly the exponential of a square.
    let (least, greatest) =
        (ratios[ratios.len() / 50] / median, ratios[ratios.len() - 1 - ratios.len() / 50] / median);
    assert!(least > 0.96 && greatest < 1.04, "{least:.3} to {greatest:.3} of {median:.3}");
}

#[test]
fn what_a_mask_covers_is_not_in_the_mosaic() {
    // A bumper in the lower third of every image: white, which the ground never is.
    let covered = 160 * 80..160 * 120;
    let picture = |mask: Option<&ImageMask>| {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.gpkg");
        let mut map = MapFile::create(&path, &ground::camera(), &Rig::level(0.5)).unwrap();
        let session = map.begin_session("drive.mp4").unwrap();
        for number in 0..12 {
            let mut image = ground::image(number);
            image.gray.samples_mut()[covered.clone()].fill(255);
            map.add_keyframe(&ground::keyframe(number, session), &image, &[]).unwrap();
        }
        map.set_mask(session, mask).unwrap();
        map.render_mosaic(Some(0.004), &mut |_| true).unwrap();
        map.mosaic_picture(usize::MAX).unwrap().unwrap()
    };
    let mut shown = GrayImage::new(160, 120);
    shown.samples_mut()[..covered.start].fill(255);
    let (without, with) = (picture(None), picture(Some(&ImageMask::from_picture(&shown))));
    let seen = |picture: &MosaicPicture| picture.rgba.chunks(4).filter(|pixel| pixel[3] > 0).count();
    let white = |picture: &MosaicPicture| {
        picture.rgba.chunks(4).filter(|pixel| pixel[3] > 0 && pixel[0] > 240).count()
    };
    assert!(10 * white(&without) > seen(&without), "{} of {}", white(&without), seen(&without));
    assert_eq!(white(&with), 0);
    assert!(2 * seen(&with) > seen(&without));
    // No darker or brighter margin is left along the mask: the brightness of both is that of the
    // ground.
    let gray = |picture: &MosaicPicture| {
        let ground = windows(picture).into_iter().map(|(_, gray)| gray).filter(|gray| *gray < 200.0);
        let grays: Vec<f64> = ground.collect();
        grays.iter().sum::<f64>() / grays.len() as f64
    };
    let even = mosaic(|_, image| image, ground::pose);
    assert!((gray(&with) / gray(&even) - 1.0).abs() < 0.02, "{} {}", gray(&with), gray(&even));
}

#[test]
fn a_geotiff_ends_where_the_ground_does() {
    let folder = tempfile::tempdir().unwrap();
    let mut map = ground::map_of(&folder.path().join("map.gpkg"), 12);
    map.render_mosaic(Some(0.004), &mut |_| true).unwrap();
    let layer = map.mosaic().unwrap().unwrap();
    let mut bytes = Cursor::new(Vec::new());
    let picture = map.write_geotiff(&layer, &mut bytes, None, &mut || Ok(())).unwrap();
    bytes.set_position(0);
    let (width, height) = Decoder::new(bytes).unwrap().dimensions().unwrap();
    assert_eq!((picture.width, picture.height), (width.into(), height.into()));
    // Its left and upper borders are those of a tile.
    assert!(layer.columns.start < 256 && layer.rows.start < 256, "{layer:?}");
    assert_eq!((picture.width, picture.height), (layer.columns.end, layer.rows.end));
    assert!([picture.width, picture.height].iter().all(|side| !side.is_multiple_of(256)), "{picture:?}");
}

#[test]
fn a_geotiff_has_its_directories_and_its_overviews_first() {
    let folder = tempfile::tempdir().unwrap();
    let mut map = ground::map_of(&folder.path().join("map.gpkg"), 12);
    map.render_mosaic(Some(0.001), &mut |_| true).unwrap();
    let layer = map.mosaic().unwrap().unwrap();
    const SIDE: usize = odograph::mosaic::MOSAIC_TILE_PX;
    let mut bytes = Cursor::new(Vec::new());
    map.write_geotiff(&layer, &mut bytes, None, &mut || Ok(())).unwrap();
    let written = bytes.into_inner();
    let mut tiff = Decoder::new(Cursor::new(&written)).unwrap();
    let mut before = written.len() as u64;
    for level in (0..=layer.finest).rev() {
        let finer = 1 << (layer.finest - level);
        let size = [layer.columns.end, layer.rows.end].map(|side| side.div_ceil(finer));
        let (width, height) = tiff.dimensions().unwrap();
        assert_eq!([width, height].map(u64::from), size);
        let reduced = tiff.find_tag_unsigned::<u32>(Tag::NewSubfileType).unwrap();
        assert_eq!(reduced, (finer > 1).then_some(1));
        // The tiles of each picture are behind all directories and before those of the finer one.
        let places = tiff.get_tag_u64_vec(Tag::TileOffsets).unwrap();
        let lengths = tiff.get_tag_u64_vec(Tag::TileByteCounts).unwrap();
        let offsets: Vec<u64> = places.iter().copied().filter(|offset| *offset > 0).collect();
        assert!(offsets.is_sorted() && *offsets.last().unwrap() < before, "{level}: {offsets:?}");
        before = offsets[0];
        assert!(tiff.ifd_pointer().unwrap().0 < before);
        let across = width.div_ceil(SIDE as u32);
        for (column, row) in map.mosaic_tiles(level).unwrap() {
            let index = (row as u32 * across + column as u32) as usize;
            let (at, length) = (places[index] as usize, lengths[index] as usize);
            let around = &written[at - 4..at + length + 4];
            assert_eq!(around[..4], (length as u32).to_le_bytes());
            assert_eq!(around[length..length + 4], around[length + 4..]);
            let DecodingResult::U8(shown) = tiff.read_chunk(index as u32).unwrap() else {
                panic!("samples are not bytes")
            };
            let tile = map.mosaic_tile(level, column, row).unwrap().unwrap();
            let across = shown.len() / 4 / SIDE.min(size[1] as usize - SIDE * row as usize);
            let rows = tile.chunks(4 * SIDE).zip(shown.chunks(4 * across));
            rows.for_each(|(tile, shown)| assert_eq!(&tile[..4 * across], shown));
        }
        if level > 0 {
            tiff.next_image().unwrap();
        }
    }
    assert!(layer.finest >= 2 && !tiff.more_images(), "{layer:?}");
}

#[test]
fn misaligned_views_are_not_blurred() {
    let contrast = |picture: &MosaicPicture| {
        let step =
            |at: usize| (f64::from(picture.rgba[4 * at]) - f64::from(picture.rgba[4 * at + 4])).powi(2);
        let inside = (0..picture.width * picture.height - 1)
            .filter(|at| picture.rgba[4 * at + 3] == 255 && picture.rgba[4 * at + 7] == 255);
        let steps: Vec<f64> = inside.map(step).collect();
        (steps.iter().sum::<f64>() / steps.len() as f64).sqrt()
    };
    let exact = mosaic(|_, image| image, ground::pose);
    // Each keyframe is displaced by one or two pixels: averaging all views would lose much of the
    // texture's contrast.
    let off = mosaic(
        |_, image| image,
        |number| {
            let pose = ground::pose(number);
            let (sin, cos) = (2.4 * number as f64).sin_cos();
            GroundPose { x_m: pose.x_m + 0.006 * cos, y_m: pose.y_m + 0.006 * sin, ..pose }
        },
    );
    let kept = contrast(&off) / contrast(&exact);
    assert!(kept > 0.85, "{kept}");
}
