"""What type checkers find wrong: without an error that is ignored here, the comment that ignores it is one."""

import torch

import camtorch as ct

camera = ct.Pinhole([300.0, 300, 320, 240], image_size=(480, 640))
images = torch.rand(1, 3, 480, 640)

ct.Pinhole([300.0, 300, 320, 240], image_size=480)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
ct.Pinhole("300 300 320 240")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
ct.Fisheye([300.0, 300, 320, 240])  # type: ignore[attr-defined]  # pyright: ignore
camera.distort(images)  # type: ignore[operator]  # pyright: ignore[reportCallIssue]
camera.crop(0, 0, "100", 100)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
camera("a point")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
camera(images, images)  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
pixels: torch.Tensor = camera.project(images)  # type: ignore[assignment]  # pyright: ignore[reportAssignmentType]
other: ct.Mei = camera.convert(ct.Fisheye624).camera  # type: ignore[assignment]  # pyright: ignore[reportAssignmentType]
camera.convert(ct.Fisheye624, count="many")  # type: ignore[arg-type]  # pyright: ignore
ct.Warp(camera)  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
ct.Warp(camera, camera)("image.png")  # type: ignore[type-var]  # pyright: ignore[reportArgumentType]
ct.Dewarp(camera, projection="flat")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
ct.load(3)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
ct.losses.rays(camera, camera, reduction="sum")  # type: ignore[call-overload]  # pyright: ignore
ct.augment.Resize((240, 320), mod="nearest")  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
