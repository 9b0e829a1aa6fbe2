//! Triangulation and meshing on exact clouds.
use acies::mesh::delaunay::Delaunay;
use acies::mesh::check::check_delaunay;
use acies::mesh::star::*;
use acies::mesh::umbrella::*;
use glam::DVec3;
#[path = "../tests/clouds/mod.rs"]
mod clouds;
use clouds::solids;
fn file(name: &str) -> Vec<DVec3> { acies::points::read(std::path::Path::new(&format!("/work/shared/data/models/{name}")), acies::points::Unit::Millimetre).unwrap().cloud.positions }

fn clouds_m(n: &str) -> Vec<DVec3> { std::fs::read_to_string(format!("/work/shared/data/sharp-labels/{n}")).unwrap().lines().filter(|l| l.starts_with("Vertex ")).map(|l| { let w: Vec<f64> = l.split_whitespace().skip(2).take(3).map(|x| x.parse().unwrap()).collect(); DVec3::from_slice(&w) }).collect() }
fn main() {
    let want = std::env::var("CLOUDS").unwrap_or_default();
    let mut list: Vec<(&str, Vec<DVec3>)> = vec![];
    list.push(("bunny", file("stanford-bunny.obj")));
    list.push(("fandisk", file("fandisk.obj")));
    list.push(("cube", solids::cube(10.0).even(10_250, 580).points));
    list.push(("hole17k", solids::cube_with_hole(10.0).even(17_400, 839).points));
    for n in [0.4, 0.8, 1.2, 2.0] { let c = solids::cube_with_hole(10.0).even(17_400, 839); let r = n / 100.0 * 8.5 / 0.25 * c.spacing; list.push(("noisy", c.shaken(r, 5).points)); }
    list.push(("mechpart", clouds_m("mechpart.recon.m"))); list.push(("blob", clouds_m("standingblob.orig.m")));
    list.push(("hole58k", solids::cube_with_hole(10.0).even(58_720, 1_350).points));
    list.push(("part100k", solids::block().sample(100_000, 0.1, 1).points));
    list.push(("part500k", solids::block().sample(500_000, 0.1, 1).points));
    let g: Vec<DVec3> = (0..1_000_000).map(|i| DVec3::new((i % 100) as f64, (i / 100 % 100) as f64, (i / 10000) as f64)).collect();
    list.push(("grid", g));
    for (name, p) in list {
        if !want.is_empty() && !want.split(',').any(|w| w == name) { continue; }
        let t = std::time::Instant::now();
        let d = Delaunay::new(&p).unwrap();
        println!("{name} {} cells {} {:.3}", p.len(), d.finite_cells(), t.elapsed().as_secs_f64());
        if std::env::var("CHECK").is_ok() { println!("{:?}", check_delaunay(&d)); }
        let t = std::time::Instant::now();
        let stars = Stars::new(&d);
        println!("  stars {:.3}", t.elapsed().as_secs_f64());
        let facets = Facets::new(&d);
        println!("  facets {:.3}", t.elapsed().as_secs_f64());
        let m = match_umbrellas(&d, &stars, &facets, std::env::var("CONE").is_ok());
        println!("  matching {:.3} {:?}", t.elapsed().as_secs_f64(), m.matched.iter().map(|x| (10000.0 * *x as f64 / d.points.len() as f64).round() / 100.0).collect::<Vec<_>>());
        let mut solid = acies::mesh::solid::vote(&d, &stars, &facets);
        println!("  vote {:.3} weak {}", t.elapsed().as_secs_f64(), solid.votes.iter().filter(|v| v.abs() < 4).count());
        if std::env::var("SETTLE").is_ok() { acies::mesh::solid::settle(&d, &facets, &mut solid); }
        println!("  before: {:?}", acies::mesh::check::topology(d.points.len(), &acies::mesh::solid::surface(&d, &solid.inside)));
        println!("  mend {:?} {:.3}", acies::mesh::mend::mend(&d, &stars, &facets, &mut solid), t.elapsed().as_secs_f64());
        let tri = acies::mesh::solid::surface(&d, &solid.inside);
        let topo = acies::mesh::check::topology(d.points.len(), &tri);
        println!("  {:?} genus {:?} of 2V-4 {}", topo, topo.genus(), 2 * d.points.len() - 4);
    }
}
