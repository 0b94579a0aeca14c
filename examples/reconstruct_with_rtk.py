"""A data set reconstructed by RTK (FDK), with the geometry that `flexdt export` wrote for it.

    flexdt export DATASET --format rtk --out geometry.xml
    python examples/reconstruct_with_rtk.py DATASET geometry.xml OUT.npy [VOXEL_MM] [VOXELS]

Needs itk-rtk. The images go in as they are, row 0 on top. The volume comes out in the order z,
y, x, layers from the lowest up, as a volume by `flexdt reconstruct`.
"""

import sys
import warnings

import numpy as np

from flexdt.library.reading.folders import load_dataset

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # its wrappers warn while they load
    import itk

    RTK, KIND = itk.RTK, itk.Image[itk.F, 3]
    FDK = RTK.FDKConeBeamReconstructionFilter[KIND]
    READER = RTK.ThreeDCircularProjectionGeometryXMLFileReader
    EMPTY = RTK.ConstantImageSource[KIND]


def main(argv: list[str]) -> None:
    """Reconstruct a data set by RTK's FDK with the geometry of an exported file, and save
    the volume (z, y, x) as .npy.

    `argv` has the data set's folder, RTK's geometry file, the output and, if given, voxel
    [mm] (0.5) and voxels a side (128).
    """
    data = load_dataset(argv[0])
    pixel = float(np.linalg.norm(data.cone_vec.u[0]))
    voxel = float(argv[3]) if len(argv) > 3 else 0.5
    count = int(argv[4]) if len(argv) > 4 else 128

    reader = READER.New()
    reader.SetFilename(argv[1])
    reader.GenerateOutputInformation()

    rows, cols = data.shape
    stack = itk.image_from_array(data.stack())
    stack.SetSpacing([pixel, pixel, 1.0])
    stack.SetOrigin([-(cols - 1) / 2 * pixel, -(rows - 1) / 2 * pixel, 0.0])

    empty = EMPTY.New()
    empty.SetSize([count] * 3)
    empty.SetSpacing([voxel] * 3)
    empty.SetOrigin([-(count - 1) / 2 * voxel] * 3)

    fdk = FDK.New()
    fdk.SetInput(0, empty.GetOutput())
    fdk.SetInput(1, stack)
    fdk.SetGeometry(reader.GetOutputObject())
    fdk.Update()
    # RTK's (x, y, z) is our (x, z, -y).
    volume = itk.array_from_image(fdk.GetOutput())[::-1].transpose(1, 0, 2)
    np.save(argv[2], np.ascontiguousarray(volume))
    print(
        f"{argv[2]}: {count} voxels of {voxel:g} mm a side, largest {volume.max():.4g} /mm"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
