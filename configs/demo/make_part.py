"""Makes part.step, the nominal of the demo's part, with Open CASCADE.

Run it where `pip install "cadquery-ocp<8"` has been done: python make_part.py [part.step]

The numbers are those of simulators/src/demo_part.rs; a test there compares the file with them.
"""

import re
import sys

from OCP.BRep import BRep_Tool
from OCP.BRepAdaptor import BRepAdaptor_Curve, BRepAdaptor_Surface
from OCP.BRepAlgoAPI import BRepAlgoAPI_Common, BRepAlgoAPI_Fuse
from OCP.BRepBuilderAPI import (
    BRepBuilderAPI_MakeEdge,
    BRepBuilderAPI_MakeFace,
    BRepBuilderAPI_MakeSolid,
    BRepBuilderAPI_MakeWire,
    BRepBuilderAPI_Sewing,
)
from OCP.BRepCheck import BRepCheck_Analyzer
from OCP.BRepGProp import BRepGProp
from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder
from OCP.GeomAbs import GeomAbs_CurveType, GeomAbs_SurfaceType
from OCP.Geom import Geom_BSplineSurface
from OCP.GProp import GProp_GProps
from OCP.IFSelect import IFSelect_RetDone
from OCP.Interface import Interface_Static
from OCP.ShapeUpgrade import ShapeUpgrade_UnifySameDomain
from OCP.STEPControl import STEPControl_AsIs, STEPControl_Writer
from OCP.TColgp import TColgp_Array2OfPnt
from OCP.TColStd import TColStd_Array1OfInteger, TColStd_Array1OfReal
from OCP.TopAbs import TopAbs_EDGE, TopAbs_FACE, TopAbs_SHELL, TopAbs_SOLID
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS
from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt

# control heights; the first index runs along x
TOP_Z = [
    [23.0, 24.0, 23.5, 22.5],
    [24.0, 25.5, 25.0, 23.5],
    [24.5, 25.0, 25.5, 24.0],
    [23.5, 24.5, 24.0, 23.0],
]
WALL, WIDTH, PLATE_TOP, LENGTH = 32.0, 50.0, 12.0, 80.0


def top_surface():
    poles = TColgp_Array2OfPnt(1, 4, 1, 4)
    for i in range(4):
        for j in range(4):
            poles.SetValue(i + 1, j + 1, gp_Pnt(WALL * i / 3, WIDTH * j / 3, TOP_Z[i][j]))
    knots = TColStd_Array1OfReal(1, 2)
    knots.SetValue(1, 0.0)
    knots.SetValue(2, 1.0)
    multiplicities = TColStd_Array1OfInteger(1, 2)
    multiplicities.SetValue(1, 4)
    multiplicities.SetValue(2, 4)
    return Geom_BSplineSurface(poles, knots, knots, multiplicities, multiplicities, 3, 3)


def each(shape, kind):
    explorer = TopExp_Explorer(shape, kind)
    seen = []
    while explorer.More():
        item = explorer.Current()
        if not any(item.IsSame(s) for s in seen):
            seen.append(item)
        explorer.Next()
    return seen


def block():
    """The block from z = 12 up to the free-form top: five planes and the B-spline face, sewn on common edges."""
    top = BRepBuilderAPI_MakeFace(top_surface(), 1e-7).Face()
    rims = [TopoDS.Edge_s(e) for e in each(top, TopAbs_EDGE)]
    corners = [gp_Pnt(0, 0, PLATE_TOP), gp_Pnt(WALL, 0, PLATE_TOP), gp_Pnt(WALL, WIDTH, PLATE_TOP), gp_Pnt(0, WIDTH, PLATE_TOP)]
    foot = [BRepBuilderAPI_MakeEdge(corners[i], corners[(i + 1) % 4]).Edge() for i in range(4)]
    sewing = BRepBuilderAPI_Sewing(1e-6)
    sewing.Add(top)
    wire = BRepBuilderAPI_MakeWire(*foot).Wire()
    sewing.Add(BRepBuilderAPI_MakeFace(wire, True).Face())
    for i in range(4):
        a, b = corners[i], corners[(i + 1) % 4]

        def over(p):
            x, y = round(p.X() / WALL), round(p.Y() / WIDTH)
            return gp_Pnt(p.X(), p.Y(), TOP_Z[3 * x][3 * y])

        def between(edge):
            curve = BRepAdaptor_Curve(edge)
            ends = [curve.Value(curve.FirstParameter()), curve.Value(curve.LastParameter())]
            return all(min(e.Distance(over(a)), e.Distance(over(b))) < 1e-6 for e in ends)

        rim = next(e for e in rims if between(e))
        sides = [BRepBuilderAPI_MakeEdge(a, over(a)).Edge(), BRepBuilderAPI_MakeEdge(b, over(b)).Edge()]
        maker = BRepBuilderAPI_MakeWire(foot[i], sides[0], rim, sides[1])
        sewing.Add(BRepBuilderAPI_MakeFace(maker.Wire(), True).Face())
    sewing.Perform()
    shell = TopoDS.Shell_s(each(sewing.SewedShape(), TopAbs_SHELL)[0])
    solid = BRepBuilderAPI_MakeSolid(shell).Solid()
    volume = GProp_GProps()
    BRepGProp.VolumeProperties_s(solid, volume)
    return solid if volume.Mass() > 0 else TopoDS.Solid_s(solid.Reversed())


def part():
    plate = BRepPrimAPI_MakeBox(LENGTH, WIDTH, PLATE_TOP).Shape()
    boss = BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(56, 25, PLATE_TOP), gp_Dir(0, 0, 1)), 9.0, 8.0).Shape()
    fused = BRepAlgoAPI_Fuse(BRepAlgoAPI_Fuse(plate, block()).Shape(), boss).Shape()
    unify = ShapeUpgrade_UnifySameDomain(fused, True, True, False)
    unify.Build()
    solids = each(unify.Shape(), TopAbs_SOLID)
    assert len(solids) == 1, len(solids)
    return solids[0]


def main():
    path = sys.argv[1] if len(sys.argv) > 1 else "part.step"
    shape = part()
    assert BRepCheck_Analyzer(shape).IsValid()
    faces, edges = each(shape, TopAbs_FACE), each(shape, TopAbs_EDGE)
    for face in faces:
        kind = BRepAdaptor_Surface(TopoDS.Face_s(face)).GetType()
        area = GProp_GProps()
        BRepGProp.SurfaceProperties_s(face, area)
        c = area.CentreOfMass()
        print(str(kind).split("_")[-1], f"area {area.Mass():.4f} at {c.X():.3f} {c.Y():.3f} {c.Z():.3f}")
    for edge in edges:
        curve = BRepAdaptor_Curve(TopoDS.Edge_s(edge))
        a, b = curve.Value(curve.FirstParameter()), curve.Value(curve.LastParameter())
        kind = str(curve.GetType()).split("_")[-1]
        print(kind, *(f"({p.X():.3f} {p.Y():.3f} {p.Z():.3f})" for p in (a, b)))
    volume = GProp_GProps()
    BRepGProp.VolumeProperties_s(shape, volume)
    print(f"{len(faces)} faces, {len(edges)} edges, volume {volume.Mass():.6f}")
    writer = STEPControl_Writer()
    Interface_Static.SetCVal_s("write.step.schema", "AP214IS")
    Interface_Static.SetCVal_s("write.step.unit", "MM")
    Interface_Static.SetCVal_s("write.step.product.name", "acies-demo-part")
    assert writer.Transfer(shape, STEPControl_AsIs) == IFSelect_RetDone
    assert writer.Write(path) == IFSelect_RetDone
    # the writer numbers products, and stamps the hour: the same part gives the same file
    with open(path) as file:
        text = file.read()
    text = text.replace("acies-demo-part 1", "acies-demo-part")
    text = re.sub(r"'\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d'", "'2026-01-01T00:00:00'", text)
    with open(path, "w") as file:
        file.write(text)


if __name__ == "__main__":
    main()
