"""The fields of Waygate's (phoenix's) .pca; names are SECTION/KEY."""

from __future__ import annotations

from typing import Final

from flexdt.twin.dataset.format_table import (
    ANGLES,
    BEAM,
    GEOMETRY,
    FormatTable,
    dropped,
    noted,
    noted_all,
    refused,
    used,
)

PHOENIX: Final = FormatTable(
    "phoenix",
    "public .pca files of a v|tome|x m and a nanotom; no images of Waygate's were at hand",
    (
        used("Geometry/FDD", "source to panel", "the geometry", "mm", of=GEOMETRY),
        used("Geometry/FOD", "source to axis", "the geometry", "mm", of=GEOMETRY),
        used(
            "Geometry/VoxelSizeX",
            "pixel at the axis",
            "the panel's columns",
            "mm",
            of=GEOMETRY,
        ),
        used(
            "Geometry/VoxelSizeY",
            "the same of rows",
            "the panel's rows",
            "mm",
            of=GEOMETRY,
        ),
        used("Geometry/Magnification", "FDD / FOD", "it is compared", of=GEOMETRY),
        used(
            "Geometry/cx", "column of the central ray", "the axis", "pixels", of=GEOMETRY
        ),
        used(
            "Geometry/cy",
            "row of the source's plane",
            "the panel's height",
            "pixels",
            of=GEOMETRY,
        ),
        used("CT/NumberImages", "number of images", "the views"),
        used("CT/RotationSector", "turn of all views", "the views", "deg", of=ANGLES),
        used(
            "Detector/PixelsizeX",
            "pixel of the panel",
            "it is compared",
            "mm",
            of=GEOMETRY,
        ),
        used(
            "Detector/PixelsizeY", "the same of rows", "it is compared", "mm", of=GEOMETRY
        ),
        used("Image/DimX", "columns", "the images are compared with it"),
        used("Image/DimY", "rows", "the images are compared with it"),
        used("Image/FreeRay", "counts of the open beam", "the flat image", of=BEAM),
        used("CT/FreeRayFactor", "factor of FreeRay", "the flat image", of=BEAM),
        used("Xray/Voltage", "voltage of the tube", "reconstruct with material=", "kV"),
        dropped(
            "Geometry/CalibValue",
            "shift of the axis [pixels]",
            "its sign is not documented: the axis is taken at cx; `align` or "
            "`fx.find_convention` decides",
            of=GEOMETRY,
        ),
        dropped(
            "Geometry/DetectorRot",
            "roll of the panel [deg]",
            "the panel is taken to stand upright; `align` finds its roll",
            of=GEOMETRY,
        ),
        dropped(
            "Geometry/Tilt", "tilt of the panel [deg]", "it is taken as 0", of=GEOMETRY
        ),
        *(
            dropped(
                f"Image/{name}",
                what,
                "the images are taken as they are stored, unmirrored",
            )
            for name, what in (
                ("Rotation", "turn of the images"),
                ("MirrorX", "mirrored columns"),
                ("MirrorY", "mirrored rows"),
            )
        ),
        dropped(
            "CT/NoRotation",
            "views without a turn",
            "even steps of a turn are taken",
            of=ANGLES,
        ),
        dropped(
            "DetectorShift/Enable",
            "the panel moves between views against rings",
            "the images are taken to be put back",
            of=GEOMETRY,
        ),
        *(
            refused(
                f"{section}/Active",
                what,
                "give geometry= for another trajectory than one circle",
                of=GEOMETRY,
            )
            for section, what in (
                ("Trajectory", "a helix or another trajectory"),
                ("Multiscan", "several scans"),
                ("SectorScan", "a scan in parts"),
            )
        ),
        *noted_all(
            "VSensor/NumTiles VSensor/Start VSensor/EnableTiles VSensor/Interval "
            "VSensor/Overlap VSensor/AdjustImg VSensor/SingleImgX "
            "FastCT/Active Multiline/Installed",
            "tiles, joined in the images",
        ),
        *noted_all(
            "Version Version-pca Comment LoadDefault SystemName",
            "words",
            under="General/",
        ),
        *noted_all(
            "Active ImgNr ImageString Skip", "search of the axis", under="AutoScO/"
        ),
        *noted_all("Old_CalibValue", "before a correction", under="Geometry/"),
        *noted_all(
            "Type StartImg EstimatedTime RemainingTime ScanTimeCmpl NrImgDone "
            "NrImgCmplScan RefDriveEnabled SkipForNewInterval SkipAcc UpdateView Wnd_L "
            "Wnd_T Wnd_R Wnd_B Level",
            "how the scan was taken",
            under="CT/",
        ),
        *noted_all(
            "NumberImages Averaging Skip", "search of the axis", under="CalibValue/"
        ),
        *noted_all("Top Left Bottom Right BitPP", "of the images", under="Image/"),
        *noted_all("SwBin AddSwBin", "binning; VoxelSize has it", under="ImgProc/"),
        *noted_all(
            "Enable Counter MaxTimes TimeTrigOn kV Time", "of the tube", under="Warmup/"
        ),
        *noted_all(
            "MGainMode MGainPoints Avg Skip EnableAutoAcq MGainVoltage MGainCurrent GainImg "
            "MGainImg OffsetImg DefPixelImg",
            "undone in the images already",
            under="CalibImages/",
        ),
        *noted_all(
            "Mode Amplitude Interval Step", "of the shift", under="DetectorShift/"
        ),
        *noted_all(
            "InitTimeOut Name NrPixelsX NrPixelsY Timing TimingVal Avg Skip Binning BitPP "
            "CameraGain SatValue SatPixNrLimit Gain",
            "of the detector",
            under="Detector/",
        ),
        *noted_all(
            "ComPort Name ID InitTimeout Current Mode Filter Collimation WaitTime "
            "WaitForStable FocDistX FocDistY SpinStepkV SpinStepuA Macro RestrictNumSpots "
            "PreWarning MinGainCurrent",
            "of the tube",
            "`tube=` of reconstruct takes it",
            under="Xray/",
        ),
        *noted_all(
            "InitTimeout CollisionDetection JoyDriveDoorOpen SecPosSample MinSampleDetPos "
            "EnableKeyboardJoy KeyJoyVelocityFactor",
            "of the motors",
            under="Cnc/",
        ),
        *(
            noted(f"CNC_?/{name}", "where a motor stood", "FDD, FOD, cx and cy have it")
            for name in ("LoadPos", "AcqPos")
        ),
        *noted_all(
            "XSample YSample ZSample RSample TSample YTube ZTube XDetector YDetector "
            "ZDetector WDetector ColSlave",
            "where motors stood",
            "FDD, FOD, cx and cy have it",
            under="Axis/",
        ),
    ),
    "VoxelSize times FDD / FOD before Pixelsize; FDD and FOD before Magnification.",
    example='fx.open("part/part.pca")',
)
