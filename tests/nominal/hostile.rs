//! Small files that would take all time or memory if the reader let them.

use super::{BOX, parse, refusal};

/// The box with more entities in it.
fn box_with(more: &str) -> String {
    BOX.replace("ENDSEC;\nEND-ISO", &format!("{more}ENDSEC;\nEND-ISO"))
}

#[test]
fn an_assembly_that_doubles_forty_times_is_refused() {
    // Every level holds the next one twice; there is no body at the end that would be counted.
    let mut more = String::new();
    for level in 0..=40 {
        more += &format!("#{}=SHAPE_REPRESENTATION('',(#4),#3);\n", 200 + level);
    }
    for relation in 0..80 {
        let parent = 200 + relation / 2;
        more += &format!(
            "#{}=SHAPE_REPRESENTATION_RELATIONSHIP('','',#{parent},#{});\n",
            300 + relation,
            parent + 1
        );
    }
    assert_eq!(
        refusal(&box_with(&more)),
        "part.step: the assembly unfolds into more than 20000 occurrences of its parts; export one part at a time"
    );
}

#[test]
fn bodies_that_double_twenty_times_are_refused() {
    let mut more = "#199=SHAPE_REPRESENTATION('',(#117),#3);\n".to_owned();
    more += "#198=SHAPE_REPRESENTATION('',(#4),#3);\n";
    more += "#197=AXIS2_PLACEMENT_3D('',#6,$,$);\n#196=AXIS2_PLACEMENT_3D('',#4,$,$);\n";
    for level in 0..20 {
        let child = if level == 0 { 199 } else { 199 + level };
        let map = 300 + 3 * level;
        more += &format!(
            "#{map}=REPRESENTATION_MAP(#196,#{child});\n#{}=MAPPED_ITEM('',#{map},#196);\n\
             #{}=MAPPED_ITEM('',#{map},#197);\n#{}=SHAPE_REPRESENTATION('',(#{},#{}),#3);\n",
            map + 1,
            map + 2,
            200 + level,
            map + 1,
            map + 2
        );
    }
    assert!(
        refusal(&box_with(&more))
            .starts_with("part.step: the assembly unfolds into more than 20000"),
    );
}

#[test]
fn faces_that_cannot_be_used_count_as_well() {
    let text = BOX.replace("(#46,", &format!("(#46,{}", "#4,".repeat(200_000)));
    assert_eq!(
        refusal(&text),
        "part.step: more than 200000 faces with all occurrences of its parts; export one part at a time"
    );
}

#[test]
fn a_face_listed_again_is_used_once() {
    let n = parse(&BOX.replace("(#46,", "(#46,#46,#46,"));
    assert_eq!((n.faces.len(), n.sharp_edges.len()), (6, 12));
    let reasons: Vec<(u64, &str)> = n
        .refused
        .iter()
        .map(|r| (r.entity, &r.reason[..]))
        .collect();
    assert_eq!(reasons, [(46, "the body lists it before"); 2]);
}

#[test]
fn a_face_whose_loops_repeat_an_edge_is_refused() {
    let n = parse(&BOX.replace("'',(#29,#33", &format!("'',({}#33", "#29,".repeat(10_000))));
    assert_eq!((n.faces.len(), n.refused.len()), (5, 1));
    assert_eq!(n.refused[0].entity, 46);
    assert_eq!(
        n.refused[0].reason,
        "its loops use edge #28 more than twice"
    );
}

#[test]
fn one_long_edge_in_five_hundred_faces_is_refused() {
    // Twenty thousand points along the edge, and each face takes them twice.
    let (mut more, mut ids) = (String::new(), String::from("#4"));
    for i in 1..5000 {
        let x = 30.0 * f64::from(i) / 5000.0;
        more += &format!("#{}=CARTESIAN_POINT('',({x:?},0.,0.));\n", 1000 + i);
        ids += &format!(",#{}", 1000 + i);
    }
    more += &format!("#200=POLYLINE('',({ids},#6));\n#201=EDGE_CURVE('',#5,#7,#200,.T.);\n");
    more += "#202=ORIENTED_EDGE('',*,*,#201,.T.);\n#203=EDGE_LOOP('',(#202,#202,#202));\n";
    more += "#204=FACE_OUTER_BOUND('',#203,.T.);\n";
    let mut faces = String::new();
    for i in 0..520 {
        more += &format!("#{}=ADVANCED_FACE('',(#204),#45,.T.);\n", 300 + i);
        faces += &format!("#{},", 300 + i);
    }
    let text = box_with(&more).replace("(#46,", &format!("({faces}#46,"));
    assert_eq!(
        refusal(&text),
        "part.step: its faces and curves take more than 20000000 points; export the part alone, without copies of its faces"
    );
}
