//! STEP files read as nominals, against Open CASCADE's answers and against bodies known in closed form.

use acies::nominal::Nominal;

#[test]
fn report() {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let oracle: serde_json::Value =
        serde_json::from_slice(&std::fs::read(root.join("cad-oracle.json")).unwrap()).unwrap();
    let mut names: Vec<_> = std::fs::read_dir(root.join("step"))
        .unwrap()
        .map(|e| e.unwrap().path())
        .collect();
    names.push(root.join("abc/00009999_003df34c1a7b4dc2bd43c5f4_step_000.step"));
    names.sort();
    for path in names {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if let Ok(only) = std::env::var("ONLY") {
            if !name.contains(&only) {
                continue;
            }
        }
        let o = &oracle[&name];
        let t = std::time::Instant::now();
        match Nominal::read(&path) {
            Ok(n) => {
                let f = |k: &str| o[k].as_f64().unwrap_or(f64::NAN);
                eprintln!(
                    "{name}: {:.2}s bodies {}/{} faces {}/{} edges {}/{} area {:.5} vol {:.5} len {:.1}/{:.1} sharp {} refused {}",
                    t.elapsed().as_secs_f64(),
                    n.bodies,
                    o["solids"],
                    n.faces.len(),
                    o["faces"],
                    n.edges.len(),
                    o["edges"],
                    n.area_mm2() / f("area_mm2"),
                    n.volume_mm3() / f("volume_mm3"),
                    n.edge_length_mm(),
                    f("edge_length_sum_mm"),
                    n.sharp_edges.len(),
                    n.refused.len()
                );
                let b: Vec<f64> = o["bbox_mm"]
                    .as_array()
                    .map(|a| a.iter().map(|x| x.as_f64().unwrap()).collect())
                    .unwrap_or(vec![0.0; 6]);
                let mine = n.bounding_box_mm;
                let mine = [
                    mine[0].x, mine[0].y, mine[0].z, mine[1].x, mine[1].y, mine[1].z,
                ];
                eprintln!(
                    "   box {:?}",
                    mine.iter()
                        .zip(&b)
                        .map(|(a, b)| ((a - b) * 1e4).round() / 1e4)
                        .collect::<Vec<_>>()
                );
                for r in n.refused.iter().take(6) {
                    eprintln!("   refused #{}: {}", r.entity, r.reason);
                }
                if std::env::var("FACES").is_ok() {
                    for f in &n.faces {
                        eprintln!("   #{} {} {:.3}", f.entity, f.surface.kind(), f.area_mm2());
                    }
                }
            }
            Err(e) => eprintln!("{name}: {e}"),
        }
    }
}

#[test]
fn abc_list() {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let n =
        Nominal::read(&root.join("abc/00009999_003df34c1a7b4dc2bd43c5f4_step_000.step")).unwrap();
    for (i, f) in n.faces.iter().enumerate() {
        eprintln!(
            "face {i} #{} {:?} {}",
            f.entity,
            f.surface.kind(),
            f.area_mm2()
        );
    }
    for e in &n.edges {
        eprintln!(
            "edge #{} {} {:?} {:?} len {}",
            e.entity,
            e.curve.kind(),
            e.range,
            e.faces,
            e.length_mm
        );
    }
    for s in &n.sharp_edges {
        eprintln!(
            "{} #{} {:?} {:?} len {} closed {} start {:?} turn {}",
            s.id,
            s.entity,
            s.faces,
            s.kind,
            s.length_mm,
            s.closed,
            s.station(&n, 0.0).point,
            s.turn_angle_rad(&n, 0.1).to_degrees()
        );
    }
}
