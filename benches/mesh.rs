//! Meshes.
use acies::mesh::*;
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
    list.push(("hole2k", solids::cube_with_hole(10.0).even(2_224, 280).points));
    for n in [0.4, 0.8, 1.2, 2.0] { let c = solids::cube_with_hole(10.0).even(17_400, 839); let r = n / 100.0 * 8.5 / 0.25 * c.spacing; list.push(("noisy", c.shaken(r, 5).points)); }
    list.push(("mechpart", clouds_m("mechpart.recon.m"))); list.push(("blob", clouds_m("standingblob.orig.m")));
    list.push(("hole58k", solids::cube_with_hole(10.0).even(58_720, 1_350).points));
    list.push(("part100k", solids::block().sample(100_000, 0.1, 1).points));
    list.push(("part500k", solids::block().sample(500_000, 0.1, 1).points));
    list.push(("part2M", solids::block().sample(2_000_000, 0.1, 1).points));
    list.push(("part10M", solids::block().sample(10_000_000, 0.1, 1).points));
    list.push(("wedge", solids::wedge(40.0, 2.0).sample(10_000, 0.1, 1).points));
    list.push(("scan1", solids::block().scan(&[DVec3::new(0.1, 0.05, 1.0).normalize()], (0.2, 1.0), 0.02, 1).points));
    for (name, p) in list {
        if !want.split(',').any(|w| w == name) { continue; }
        let s = Settings { cone: std::env::var("NOCONE").is_err(), open: std::env::var("OPEN").is_ok() };
        let t = std::time::Instant::now();
        let m = mesh(&p, s).unwrap();
        let tot = t.elapsed().as_secs_f64();
        println!("{name} {} -> {} tri, umbrellas {:.2} %, matched {:.3} %, watertight {} manifold {} genus {:?} pieces {} open {} dF {} {:?} {:.2} s", m.positions.len(), m.triangles.len(), m.matched_by_umbrellas_percent(), m.matched_percent(), m.topology.is_watertight(), m.topology.is_manifold(), m.topology.genus(), m.topology.pieces, m.topology.open_edges, m.delta_f(), m.mending, tot);
        println!("   {:?}", m.seconds.iter().map(|(n, s)| format!("{n} {s:.2}")).collect::<Vec<_>>());
        let vol: f64 = m.triangles.iter().map(|t| { let [a,b,c] = t.map(|v| m.positions[v as usize]); a.dot(b.cross(c)) / 6.0 }).sum();
        println!("   volume {vol}");
        if let Ok(d) = std::env::var("PICTURES") { std::fs::write(format!("{d}/{name}.png"), picture::render(&m.positions, &m.triangles, DVec3::new(0.5, 0.7, -0.6), (1200, 900))).unwrap(); }
    }
}
