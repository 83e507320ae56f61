use super::*;

fn page(board: &str, paper: Option<&str>) -> Result<Page> {
    Page::new(&board.parse().unwrap(), paper.map(|paper| paper.parse().unwrap()))
}

#[test]
fn a_board_uses_the_smallest_usual_paper_that_fits() {
    for (board, paper) in [
        ("charuco:8x11:20mm", "A4 paper (210 x 297 mm), portrait"),
        ("chessboard:9x6:25mm", "A4 paper (297 x 210 mm), landscape"),
        ("chessboard:9x6:40mm", "A2 paper (594 x 420 mm), landscape"),
        ("aprilgrid:6x6:88mm", "A0 paper (841 x 1189 mm), portrait"),
        ("circles:7x5:20mm", "A4 paper (297 x 210 mm), landscape"),
    ] {
        assert_eq!(page(board, None).unwrap().paper_text(), paper, "{board}");
    }
}

#[test]
fn everything_is_on_the_paper_and_apart_from_the_board() {
    for (board, paper) in [
        ("charuco:8x11:20mm", None),
        ("chessboard:9x6:25mm", None),
        ("asymmetric-circles:4x11:20mm", None),
        ("chessboard:4x3:10mm", Some("letter")),
        ("chessboard:4x3:10mm", Some("80x100mm")),
        ("chessboard:20x20:30mm", Some("1000x800mm")),
    ] {
        let page = page(board, paper).unwrap();
        let ruler_top = page.paper.height_mm - MARGIN_MM - FOOTER_MM - 1e-9;
        for RectangleMm { x, y, width, height } in &page.rectangles {
            assert!(*x >= 5.0 && x + width <= page.paper.width_mm - 5.0, "{board}");
            assert!(*y >= 5.0 && y + height <= page.paper.height_mm - 5.0, "{board}");
            assert!(y + height < ruler_top - GAP_MM + 0.1 || *y > ruler_top, "{board}: {y} + {height}");
        }
        for text in &page.texts {
            let width = LETTER_WIDTH * text.size * text.text.len() as f64;
            assert!(text.x >= 5.9 && text.x + width <= page.paper.width_mm - 5.0 + 0.1, "{text:?}");
            assert!(text.y <= page.paper.height_mm - 5.0 && text.text.is_ascii());
        }
    }
}

#[test]
fn a_board_that_does_not_fit_gets_advice() {
    let error = page("charuco:8x11:30mm", Some("a4")).unwrap_err().to_string();
    assert!(error.contains("charuco:8x11:30mm:22.5mm:4x4_50 needs 255 x 364.5 mm"), "{error}");
    assert!(error.contains("--board charuco:8x11:24mm:18mm:4x4_50 or --paper a3 would"), "{error}");
    // What is proposed does fit.
    assert!(page("charuco:8x11:24mm:18mm:4x4_50", Some("a4")).is_ok());
    assert!(page("charuco:8x11:25mm:18mm:4x4_50", Some("a4")).is_err());
    let error = page("aprilgrid:6x6:288mm", None).unwrap_err().to_string();
    assert!(
        error.contains("A0") && error.contains("--board aprilgrid:6x6:") && !error.contains("--paper"),
        "{error}"
    );
    assert!(page("chessboard:199x199:9mm", Some("a5")).unwrap_err().to_string().contains(":0.6mm"));
    assert!("a9".parse::<Paper>().unwrap_err().to_string().contains("a5, a4"));
    assert!("1x1mm".parse::<Paper>().is_err() && "NaNxNaNmm".parse::<Paper>().is_err());
}
