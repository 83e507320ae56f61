use super::*;

#[test]
fn non_finite_numbers_and_control_characters_are_escaped() {
    assert_eq!(real(f64::NAN), ".Nan");
    assert_eq!(real(f64::NEG_INFINITY), "-.Inf");
    assert_eq!(real(1e-5), "1.0e-5");
    assert_eq!(quoted("a \"b\"\n\\"), "\"a \\\"b\\\" \\\\\"");
    let mut text = String::new();
    list(&mut text, "reasons", [].into_iter());
    assert_eq!(text, "reasons: []\n");
}
