#![no_main]

libfuzzer_sys::fuzz_target!(|text: &str| {
    let path = odograph_fuzz::scratch("run.toml");
    std::fs::write(&path, text).expect("the file in memory can be written");
    if let Ok(plan) = odograph_session::RunPlan::read(&path) {
        let text = plan.text().expect("a plan that was read can be written");
        std::fs::write(&path, text).expect("the file in memory can be written");
        odograph_session::RunPlan::read(&path).expect("a written plan can be read");
    }
});
