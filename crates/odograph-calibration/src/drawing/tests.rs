use super::*;

fn drawing(text: &str) -> Drawing {
    Drawing::new(&text.parse().unwrap())
}

fn black_at(drawing: &Drawing, x_mm: f64, y_mm: f64) -> bool {
    drawing.is_black(BoardPoint { x_m: x_mm * 1e-3, y_m: y_mm * 1e-3 })
}

const BOARDS: [&str; 6] = [
    "chessboard:9x6:25mm",
    "charuco:5x7:30mm:22mm",
    "charuco:6x4:30mm:22mm:5x5_50",
    "aprilgrid:3x2:50mm:11mm",
    "circles:5x4:20mm",
    "asymmetric-circles:4x5:20mm",
];

#[test]
fn chessboard_starts_black_and_has_one_square_more_than_corners() {
    let drawing = drawing("chessboard:9x6:25mm");
    assert!((drawing.pattern().width_m() - 0.25).abs() < 1e-12);
    assert!((drawing.pattern().height_m() - 0.175).abs() < 1e-12);
    // The origin is the first corner: black at its upper left and lower right, white at the other
    // two.
    assert!(black_at(&drawing, -1.0, -1.0) && black_at(&drawing, 1.0, 1.0));
    assert!(!black_at(&drawing, 1.0, -1.0) && !black_at(&drawing, -1.0, 1.0));
    assert!(!black_at(&drawing, -26.0, -1.0) && !black_at(&drawing, 226.0, 10.0));
}

#[test]
fn shapes_cover_exactly_the_black_area() {
    for text in BOARDS {
        let drawing = drawing(text);
        let shapes = drawing.shapes();
        let sheet = drawing.sheet();
        for i in 0..5000 {
            // A rank-1 lattice of sample points over the sheet.
            let (u, v) = (f64::from(i) / 5000.0, (f64::from(i) * 0.618_033_988_7).fract());
            let point = BoardPoint {
                x_m: sheet.from.x_m + u * sheet.width_m(),
                y_m: sheet.from.y_m + v * sheet.height_m(),
            };
            let covering = shapes.iter().filter(|shape| match shape {
                Shape::Rectangle(rectangle) => rectangle.contains(point),
                Shape::Disc { center, radius_m } => {
                    (center.x_m - point.x_m).hypot(center.y_m - point.y_m) < *radius_m
                }
            });
            assert_eq!(covering.count(), usize::from(drawing.is_black(point)), "{text} {point:?}");
            let side_m = 0.002 * (f64::from(i) * 0.37).fract();
            let to = BoardPoint { x_m: point.x_m + side_m, y_m: point.y_m + side_m };
            if let Some(black) = drawing.is_black_all_over(Rectangle { from: point, to }) {
                for j in 0..16 {
                    let (u, v) = (f64::from(j % 4) / 3.0, f64::from(j / 4) / 3.0);
                    let inside = BoardPoint { x_m: point.x_m + u * side_m, y_m: point.y_m + v * side_m };
                    assert_eq!(drawing.is_black(inside), black, "{text} {inside:?}");
                }
            }
        }
    }
}

#[test]
fn charuco_markers_are_numbered_in_row_major_order() {
    // With cells of 1 mm: squares of 8 mm, markers of 6 cells, margins of 1 mm.
    let drawing = drawing("charuco:5x4:8mm:6mm:4x4_50");
    let marker_at = |column: usize, row: usize| {
        let (left, top) = (8.0 * column as f64 - 8.0 + 2.5, 8.0 * row as f64 - 8.0 + 2.5);
        (0..16).fold(0, |bits, bit| {
            let white = !black_at(&drawing, left + f64::from(bit % 4), top + f64::from(bit / 4));
            bits << 1 | u64::from(white)
        })
    };
    let whites = [(1, 0), (3, 0), (0, 1), (2, 1), (4, 1), (1, 2), (3, 2), (0, 3), (2, 3), (4, 3)];
    for (id, (column, row)) in whites.into_iter().enumerate() {
        assert_eq!(Some(marker_at(column, row)), Dictionary::Aruco4x4_50.marker(id), "marker {id}");
    }
}

#[test]
fn aprilgrid_tags_match_kalibr_in_numbering_and_orientation() {
    let drawing = drawing("aprilgrid:3x2:10mm:4mm");
    let tag_at = |column: usize, row: usize| {
        let (left, top) = (14.0 * column as f64 + 2.5, 14.0 * row as f64 + 2.5);
        (0..36).fold(0u64, |bits, bit| {
            let white = !black_at(&drawing, left + f64::from(bit % 6), top + f64::from(bit / 6));
            bits << 1 | u64::from(white)
        })
    };
    // The first and the fourth code of the family as published.
    assert_eq!(tag_at(0, 1), 0xd_5d62_8584);
    assert_eq!(tag_at(0, 0), 0xe_479e_9c98);
    // A border of two cells; black squares at the corners, also at the outer ones; white gaps.
    assert!(black_at(&drawing, 1.5, 5.0) && black_at(&drawing, -2.0, -2.0) && black_at(&drawing, 40.0, 26.0));
    assert!(!black_at(&drawing, -2.0, 5.0) && !black_at(&drawing, 12.0, 5.0));
}

#[test]
fn discs_are_centred_on_the_board_points() {
    for text in ["circles:5x4:20mm", "asymmetric-circles:4x5:20mm"] {
        let board: Board = text.parse().unwrap();
        let drawing = Drawing::new(&board);
        assert_eq!(drawing.shapes().len(), board.points().len());
        for point in board.points() {
            assert!(drawing.is_black(point));
            assert!(!drawing.is_black(BoardPoint { x_m: point.x_m + 0.0075, y_m: point.y_m }));
        }
    }
}
