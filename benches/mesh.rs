//! Meshes.
use acies::mesh::*;
use glam::DVec3;
#[path = "../tests/clouds/mod.rs"]
mod clouds;
use clouds::solids;
fn file(name: &str) -> Vec<DVec3> { acies::points::read(std::path::Path::new(&format!("/work/shared/data/models/{name}")), acies::points::Unit::Millimetre).unwrap().cloud.positions }
fn clouds_m(n: &str) -> Vec<DVec3> { std::fs::read_to_string(format!("/work/shared/data/sharp-labels/{n}")).unwrap().lines().filter(|l| l.starts_with("Vertex ")).map(|l| { let w: Vec<f64> = l.split_whitespace().skip(2).take(3).map(|x| x.parse().unwrap()).collect(); DVec3::from_slice(&w) }).collect() }
fn sharp(name: &str) -> Vec<(&'static str, Vec<(DVec3, DVec3)>)> {
    if name == "fandisk" { let text = std::fs::read_to_string("/work/shared/data/models/fandisk.obj").unwrap();
        let (mut v, mut f) = (vec![], vec![]);
        for l in text.lines() { let w: Vec<&str> = l.split_whitespace().collect(); match w.first() { Some(&"v") => { let x: Vec<f64> = w[1..4].iter().map(|w| w.parse().unwrap()).collect(); v.push(DVec3::from_slice(&x)); } Some(&"f") => { f.push([0, 1, 2].map(|k| w[k + 1].split('/').next().unwrap().parse::<usize>().unwrap() - 1)); } _ => {} } }
        let mut sides: std::collections::BTreeMap<(usize, usize), Vec<DVec3>> = Default::default();
        for t in &f { let n = (v[t[1]] - v[t[0]]).cross(v[t[2]] - v[t[0]]).normalize(); for k in 0..3 { let (a, b) = (t[k], t[(k + 1) % 3]); sides.entry((a.min(b), a.max(b))).or_default().push(n); } }
        return vec![("fandisk 40", 40f64), ("fandisk 25", 25.0)].into_iter().map(|(n, d)| (n, sides.iter().filter(|(_, n)| n.len() == 2 && n[0].angle_between(n[1]) > d.to_radians()).map(|((a, b), _)| (v[*a], v[*b])).collect())).collect();
    }
    let f = match name { "mechpart" => "mechpart.recon.m", "blob" => "standingblob.orig.m", _ => return vec![] };
    let text = std::fs::read_to_string(format!("/work/shared/data/sharp-labels/{f}")).unwrap();
    let mut v = std::collections::HashMap::new(); let mut e = vec![];
    for l in text.lines() { let w: Vec<&str> = l.split_whitespace().collect(); if l.starts_with("Vertex") { let x: Vec<f64> = w[2..5].iter().map(|w| w.parse().unwrap()).collect(); v.insert(w[1].to_owned(), DVec3::from_slice(&x)); } if l.starts_with("Edge") && l.contains("sharp") { e.push((v[w[1]], v[w[2]])); } }
    vec![("labels", e)]
}
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
        for (n, e) in sharp(name) {
            let v: std::collections::HashMap<[u64; 3], u32> = m.positions.iter().enumerate().map(|(i, p)| (p.to_array().map(f64::to_bits), i as u32)).collect();
            let es: std::collections::HashSet<(u32, u32)> = m.triangles.iter().flat_map(|t| (0..3).map(move |k| (t[k].min(t[(k + 1) % 3]), t[k].max(t[(k + 1) % 3])))).collect();
            let got = e.iter().filter(|(a, b)| { let (a, b) = (v[&a.to_array().map(f64::to_bits)], v[&b.to_array().map(f64::to_bits)]); es.contains(&(a.min(b), a.max(b))) }).count();
            println!("   {n}: {got} of {} sharp edges {:.2} %", e.len(), 100.0 * got as f64 / e.len() as f64);
        }
        let vol: f64 = m.triangles.iter().map(|t| { let [a,b,c] = t.map(|v| m.positions[v as usize]); a.dot(b.cross(c)) / 6.0 }).sum();
        println!("   volume {vol}");
        if let Ok(d) = std::env::var("PICTURES") { std::fs::write(format!("{d}/{name}.png"), picture::render(&m.positions, &m.triangles, DVec3::new(0.5, 0.7, -0.6), (1200, 900))).unwrap(); }
    }
}
