//! exploration
mod clouds;
use acies::features::{thesis, Method, detect};
use acies::points::Neighbors;
use clouds::score::cloud;
use clouds::thesis::*;
#[test]
fn explore() {
    for e in table_1() {
        let c = cloud(&e.sampled.points);
        let n = Neighbors::new(&c.positions);
        assert_eq!(e.sampled.on_edge.iter().filter(|o| **o).count() > 0, true);
        println!("{} {}", e.name, e.sampled.points.len());
        for s in [thesis::Settings::global(), thesis::Settings{adaptation: None, ..thesis::Settings::local_adaptive()}, thesis::Settings::local_adaptive()] {
            let t = std::time::Instant::now();
            let f = figures(&e.sampled, &e.sampled, &thesis::detect_as_in_thesis(&c, &n, &s));
            println!("   {:?} out {} mean {:.3} max {:.3}  {:.2}s", (f.detected,f.hits,f.features), f.outliers(), f.mean, f.largest, t.elapsed().as_secs_f64());
        }
        if false {let f = figures(&e.sampled, &e.sampled, &detect(&c,&n,Method::Adaptive).classes);
        println!("a {f:?}"); }
    }
    if std::env::var_os("T2").is_some() {
    let exact = hole_of_table_2();
    println!("{} {}", exact.points.len(), exact.spacing);
    for scale in [0.5, 1.0] {
    for (pc, a, b, n0) in TABLE_2 {
        let sh = exact.clone().shaken(scale*pc/100.0*RADIUS, 5);
        let c = cloud(&sh.points);
        let n = Neighbors::new(&c.positions);
        let s = thesis::Settings::local_adaptive();
        let f = figures(&exact, &sh, &thesis::detect_as_in_thesis(&c, &n, &s));
        let s = thesis::Settings::global();
        let h = figures(&exact, &sh, &thesis::detect_as_in_thesis(&c, &n, &s));
        let g = Figures::default();
        println!("{pc} author {a} {b} {n0} | local {:.2} {:.3} {} out {} | glob {:.2} {:.3} {} out {}| adaptive {:.2} {:.3} {} out {}", f.largest, f.mean, f.detected, f.outliers(),h.largest, h.mean, h.detected, h.outliers(), g.largest, g.mean, g.detected, g.outliers());
    }
    }
    }
    for d in FIGURE_25 {
        let e = wedge(d);
        let c = cloud(&e.points);
        let n = Neighbors::new(&c.positions);
        let f = figures(&e, &e, &thesis::detect_as_in_thesis(&c, &n, &thesis::Settings::local_adaptive()));
            println!("{d}   {:?} out {} mean {:.3} max {:.3}", (f.detected,f.hits,f.features), f.outliers(), f.mean, f.largest);
    }
}
