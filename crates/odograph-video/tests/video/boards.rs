//! Chessboard detection in real images: finds every board that OpenCV finds. Needs the images (in
//! `ODOGRAPH_DATA`, or `shared/data` beside the checkout); prints a message and skips without them.

use odograph_calibration::{Board, BoardFinder, BoardView, NotFound};
use odograph_video::{SourceOptions, open};
use std::path::{Path, PathBuf};

fn pictures(folder: &str, starting: &str) -> Option<Vec<PathBuf>> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let folder = std::env::var_os("ODOGRAPH_DATA").map_or_else(beside, PathBuf::from).join(folder);
    let Ok(entries) = std::fs::read_dir(&folder) else {
        println!("skipped: data: there is no {}", folder.display());
        return None;
    };
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.retain(|path| {
        let name = path.file_name().unwrap().to_string_lossy();
        name.starts_with(starting) && (name.ends_with("jpg") || name.ends_with("png"))
    });
    paths.sort();
    Some(paths)
}

fn find(board: &str, path: &Path) -> Result<BoardView, NotFound> {
    let board: Board = board.parse().unwrap();
    let frame = open(path, &SourceOptions::default()).unwrap().next_frame().unwrap().unwrap();
    BoardFinder::new(&board).find(&frame.gray)
}

/// Every view is complete, its rows and columns are clockwise as for a board seen from the front,
/// and neighbours are distinct.
fn check(view: &BoardView, columns: usize, rows: usize) {
    assert_eq!(view.points.len(), columns * rows);
    for (index, point) in view.points.iter().enumerate() {
        assert_eq!(point.index, index);
        if index % columns + 1 < columns && index / columns + 1 < rows {
            let (right, below) = (view.points[index + 1].pixel, view.points[index + columns].pixel);
            let (a, b) = (right.x - point.pixel.x, right.y - point.pixel.y);
            let (c, d) = (below.x - point.pixel.x, below.y - point.pixel.y);
            assert!(a * d - b * c > 9.0, "corner {index}");
        }
    }
}

#[test]
fn all_boards_of_the_stereo_pair_are_found() {
    for side in ["left", "right"] {
        let Some(paths) = pictures("calib_opencv", side) else { return };
        assert!(!paths.is_empty());
        for path in paths {
            let view =
                find("chessboard:9x6:25mm", &path).unwrap_or_else(|why| panic!("{}: {why}", path.display()));
            check(&view, 9, 6);
            let why = find("chessboard:8x6:25mm", &path).unwrap_err();
            assert!(
                matches!(why, NotFound::OtherSize { seen: (9, 6), .. }),
                "{}: looked for with 8x6: {why}",
                path.display()
            );
        }
    }
}

#[test]
fn all_complete_boards_of_the_wide_lens_are_found() {
    let Some(paths) = pictures("calib_carnd_wide/calibration_wide", "") else { return };
    for path in paths {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        match find("chessboard:8x6:25mm", &path) {
            Ok(view) => check(&view, 8, 6),
            // In these two images the board extends beyond the image.
            Err(why) if ["GOPR0055.jpg", "test_image.jpg"].contains(&name.as_str()) => {
                assert!(matches!(why, NotFound::Partial { .. }), "{name}: {why}");
            }
            Err(why) => panic!("{name}: {why}"),
        }
    }
}

#[test]
fn all_boards_with_many_squares_are_found() {
    let Some(paths) = pictures("calib_overhead_table/images", "") else { return };
    for path in paths {
        let view =
            find("chessboard:24x17:15mm", &path).unwrap_or_else(|why| panic!("{}: {why}", path.display()));
        check(&view, 24, 17);
    }
}

#[test]
fn no_board_is_found_on_the_ground() {
    let Some(paths) = pictures("ground_photos", "") else { return };
    for path in paths {
        for board in
            ["chessboard:9x6:25mm", "chessboard:3x3:25mm", "circles:4x3:20mm", "asymmetric-circles:3x4:20mm"]
        {
            assert!(find(board, &path).is_err(), "{board} in {}", path.display());
        }
    }
}
