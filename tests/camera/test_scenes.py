import numpy as np
import pytest
from scipy.ndimage import binary_dilation, gaussian_filter, map_coordinates
from skimage.io import imsave

from scsr_opt.camera.pictures import Picture, as_intensity
from scsr_opt.camera.scenes import Affine, Box, Ellipse, MovingObject, Static, Translation, TurningDisc
from scsr_opt.camera.video import Video
from scsr_opt.errors import InputError

SIZE = (70, 90)


def smooth(size: tuple[int, int] = SIZE, seed: int = 0, sigma: float = 5.0) -> np.ndarray:
    noise = gaussian_filter(np.random.default_rng(seed).standard_normal(size), sigma, mode="mirror")
    return 0.1 + 0.8 * (noise - noise.min()) / np.ptp(noise)


def dilated(mask: np.ndarray, iterations: int) -> np.ndarray:
    return np.asarray(binary_dilation(mask, iterations=iterations), bool)


SCENES = {
    "static": lambda: Static(smooth()),
    "translation": lambda: Translation(smooth(), (0.31, -0.52)),
    "rotation": lambda: Affine(smooth(), rotation=0.011),
    "zoom": lambda: Affine(smooth(), zoom=-0.008),
    "shear": lambda: Affine(smooth(), shear=0.012),
    "affine": lambda: Affine(
        smooth(), rotation=-0.006, zoom=0.004, shear=0.005, drift=(0.2, 0.3), centre=(20.0, 50.0), key=40.0
    ),
    "box": lambda: MovingObject(smooth(), smooth((40, 50), 1), (-0.4, 0.6), shape=Box(14.2, 17.4)),
    "ellipse": lambda: MovingObject(smooth(), smooth((40, 50), 1), (0.5, 0.3), position=(30.0, 50.0), key=45.0),
    "disc": lambda: TurningDisc(smooth(), smooth((60, 60), 2), -0.013),
}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("t", [50.0, 57.3])
def test_the_velocity_is_that_of_the_picture(name, t):
    """∂I/∂t + v·∇I = 0 on every surface, away from its edge."""
    scene = SCENES[name]()
    step = 1e-3
    change = (scene.frame(t + step) - scene.frame(t - step)) / (2 * step)
    picture, velocity, surface = scene.frame(t), scene.velocity(t), scene.surface(t)
    assert velocity.shape == (2, *SIZE) and picture.shape == SIZE and surface.shape == SIZE
    # Derivatives of the spline that the scene is made of; differences of pixels would be a few percent off.
    rows, columns = np.indices(SIZE).astype(float)
    slope = np.stack(
        [
            (map_coordinates(picture, [rows + a * h, columns + b * h], order=3, mode="mirror")
             - map_coordinates(picture, [rows - a * h, columns - b * h], order=3, mode="mirror")) / (2 * h)
            for a, b, h in ((1, 0, 1e-3), (0, 1, 1e-3))
        ]
    )  # fmt: skip
    left = change + (velocity * slope).sum(0)
    inside = np.zeros(SIZE, bool)
    inside[6:-6, 6:-6] = True
    for label in np.unique(surface):
        # A spline through a picture with edges rings for a few pixels.
        here = inside & ~dilated(surface != label, iterations=7)
        assert here.sum() > 100
        moving = np.abs(velocity[:, here]).max() > 0
        if moving:
            assert np.abs(change[here]).max() > 1e-3
            assert np.abs(left[here]).max() < 0.01 * np.abs(change[here]).max()
        else:
            assert np.abs(change[here]).max() == 0


@pytest.mark.parametrize("name", ["static", "translation", "rotation", "zoom", "shear", "affine"])
def test_at_the_key_time_the_picture_is_as_given(name):
    scene = SCENES[name]()
    np.testing.assert_allclose(scene.frame(scene.key), smooth(), atol=1e-12)
    assert scene.size == SIZE and scene.frame(scene.key).dtype == np.float64


def test_translation_by_whole_pixels_shifts_the_picture_down_and_right():
    picture = np.random.default_rng(0).random((20, 30))
    moved = Translation(picture, (2.0, 3.0), key=10.0).frame(11.0)
    np.testing.assert_allclose(moved[2:, 3:], picture[:-2, :-3], atol=1e-12)
    # What comes in is the reflection, whose first row repeats no pixel.
    np.testing.assert_allclose(moved[:2, 3:], picture[2:0:-1, :-3], atol=1e-12)


def test_a_quarter_turn_is_clockwise():
    picture = smooth((41, 41))
    turned = Affine(picture, rotation=np.pi / 2, key=0.0).frame(1.0)
    np.testing.assert_allclose(turned, np.rot90(picture, -1), atol=1e-9)
    disc = TurningDisc(np.zeros((41, 41)), picture, np.pi / 2, radius=15.0, key=0.0)
    inside = disc.surface(0.0) > 0
    well_inside = ~dilated(~inside, iterations=2)
    np.testing.assert_allclose(disc.frame(1.0)[well_inside], np.rot90(picture, -1)[well_inside], atol=1e-9)
    assert not disc.frame(1.0)[~dilated(inside, iterations=2)].any()
    assert inside.sum() == pytest.approx(np.pi * 15**2, rel=0.02)


def test_zoom_and_shear_go_the_way_they_say():
    rows, columns = np.indices((41, 41)) / 40
    grown = Affine(columns, zoom=np.log(2), key=0.0).frame(1.0)
    np.testing.assert_allclose(grown[20, 10:30], 0.5 + (columns[20, 10:30] - 0.5) / 2, atol=1e-3)
    leaning = Affine(columns, shear=0.5, key=0.0).velocity(0.0)
    np.testing.assert_allclose(leaning[1], (rows * 40 - 20) * 0.5, atol=1e-12)
    assert not leaning[0].any()


def test_the_path_is_followed_exactly_however_long():
    # A turn made of straight steps would spiral outwards.
    scene = Affine(smooth((61, 61)), rotation=2 * np.pi / 1000, key=0.0)
    np.testing.assert_allclose(scene.frame(1000.0), scene.frame(0.0), atol=1e-9)


def test_the_background_rests_while_the_object_hides_and_uncovers_it():
    background, picture = smooth(seed=3), smooth((40, 40), 4)
    scene = MovingObject(background, picture, (0.0, 1.5), shape=Box(9.5, 9.5), position=(35.0, 30.0), key=0.0)
    for t in (0.0, 4.0, 20.0):
        frame, surface = scene.frame(t), scene.surface(t)
        middle = 30.0 + 1.5 * t
        expected = np.zeros(SIZE, np.uint8)
        expected[26:45, int(np.ceil(middle - 9.5 - 1e-9)) : int(np.floor(middle + 9.5 + 1e-9)) + 1] = 1
        assert np.count_nonzero(surface != expected) <= 2 * 21  # a pixel half covered may count either way
        far = ~dilated(surface > 0, iterations=1)
        np.testing.assert_array_equal(frame[far], background[far])
        np.testing.assert_array_equal(scene.velocity(t)[:, far], 0)


def test_the_object_carries_its_picture_along():
    scene = MovingObject(
        np.zeros(SIZE), smooth((21, 21), 4), (1.0, 2.0), shape=Box(8.0, 8.0), position=(30.0, 40.0), key=5.0
    )
    np.testing.assert_allclose(scene.frame(5.0)[23:38, 33:48], smooth((21, 21), 4)[3:18, 3:18], atol=1e-12)
    np.testing.assert_allclose(scene.frame(8.0)[26:41, 39:54], smooth((21, 21), 4)[3:18, 3:18], atol=1e-12)
    away = scene.frame(500.0)
    assert not away.any() and not scene.surface(500.0).any()


@pytest.mark.parametrize("shape", [Box(6.3, 4.75), Ellipse(9.0, 9.0), Ellipse(7.0, 11.0)])
def test_a_shape_covers_its_area_and_moves_without_jumps(shape):
    rows, columns = np.arange(-20.0, 21)[:, None], np.arange(-20.0, 21)[None, :]
    area = 4 * 6.3 * 4.75 if isinstance(shape, Box) else np.pi * shape.semi_rows * shape.semi_columns
    before = None
    for shift in np.linspace(0, 1, 21):
        cover = shape.coverage(rows - shift, columns - shift / 3)
        assert cover.min() >= 0 and cover.max() <= 1
        assert cover.sum() == pytest.approx(area, rel=0.01)
        if before is not None:
            assert np.abs(cover - before).max() < 0.1
        before = cover


def test_a_grid_is_read_as_single_points_are_also_far_outside():
    picture = Picture(np.random.default_rng(0).random((9, 13)))
    rows, columns = np.array([-100.3, -1.2, 0.0, 3.7, 8.0, 50.9]), np.array([-30.5, 0.1, 5.0, 12.4, 77.0])
    points = picture.at(*np.meshgrid(rows, columns, indexing="ij"))
    np.testing.assert_allclose(picture.grid(rows, columns), points, atol=1e-12)
    assert points.min() >= 0 and points.max() <= 1  # where the spline overshoots


def test_pictures_of_every_kind_become_intensity():
    grey = np.array([[0, 51], [102, 255]], np.uint8)
    expected = np.array([[0, 0.2], [0.4, 1]])
    np.testing.assert_allclose(as_intensity(grey), expected)
    np.testing.assert_allclose(as_intensity(grey.astype(np.uint16) * 257), expected)
    np.testing.assert_allclose(as_intensity(expected.astype(np.float32)), expected, atol=1e-7)
    colour = np.zeros((2, 2, 4), np.uint8)
    colour[0, 0], colour[0, 1], colour[1, 0], colour[1, 1] = [255, 0, 0, 9], [0, 255, 0, 0], [0, 0, 255, 255], [255] * 4
    np.testing.assert_allclose(as_intensity(colour), [[0.299, 0.587], [0.114, 1]])
    np.testing.assert_allclose(as_intensity(colour[:, :, :3]), [[0.299, 0.587], [0.114, 1]])


def test_a_picture_handed_in_is_not_changed_and_one_handed_out_cannot_be():
    mine = np.full((4, 4), 0.5)
    scene = Static(mine)
    mine[:] = 0
    assert (scene.frame(0.0) == 0.5).all()
    with pytest.raises(ValueError, match="read-only"):
        scene.frame(0.0)[:] = 1


@pytest.mark.parametrize("motion_compensated", [False, True])
def test_a_video_shows_its_frames_exactly_when_they_are_due(motion_compensated):
    frames = np.stack([smooth((24, 30), seed) for seed in range(4)])
    video = Video(frames, readouts_per_frame=10 / 3, motion_compensated=motion_compensated)
    assert video.size == (24, 30)
    assert video.span == (0, pytest.approx(10))
    assert video.key == pytest.approx(5)
    for n in (0, 1, 2, 3, 1, 0):  # and backwards
        np.testing.assert_array_equal(video.frame(n * 10 / 3), frames[n])


def test_between_its_frames_a_video_fades():
    frames = np.stack([smooth((24, 30), seed) for seed in range(3)])
    video = Video(frames, readouts_per_frame=4)
    np.testing.assert_allclose(video.frame(5.0), 0.75 * frames[1] + 0.25 * frames[2], atol=1e-12)


def test_a_motion_compensated_video_moves_instead():
    scene = Translation(smooth((50, 60), sigma=2.0), (0.0, 0.5), key=0.0)
    frames = np.stack([scene.frame(t) for t in (0.0, 8.0)])
    truth = scene.frame(4.0)[6:-6, 6:-6]
    error = {}
    for moved in (False, True):
        between = Video(frames, readouts_per_frame=8, motion_compensated=moved).frame(4.0)[6:-6, 6:-6]
        error[moved] = np.sqrt(np.mean((between - truth) ** 2))
    assert error[True] < 0.25 * error[False]


def test_a_folder_is_read_in_the_order_of_its_numbers(tmp_path):
    frames = [np.full((6, 8), 20 * n, np.uint8) for n in range(12)]
    for n, frame in enumerate(frames):
        imsave(tmp_path / f"Frame {n}.png", frame, check_contrast=False)
    (tmp_path / "notes.txt").write_text("not a picture")
    video = Video(str(tmp_path), readouts_per_frame=2)
    for n in (0, 2, 10, 11):
        np.testing.assert_allclose(video.frame(2.0 * n), 20 * n / 255)


def test_a_video_reads_frames_when_it_needs_them_and_forgets_them():
    class Counted(list):
        reads = 0

        def __getitem__(self, n):
            self.reads += 1
            return super().__getitem__(n)

    source = Counted(smooth((5, 6), seed) for seed in range(50))
    video = Video(source, readouts_per_frame=10)
    assert source.reads == 1
    for t in range(0, 491):
        video.frame(t)
    assert source.reads == 50
    assert len(video._read) <= 3


def test_the_true_velocity_of_a_video_is_not_known():
    with pytest.raises(InputError, match="The true velocity of a video is not known: estimate it"):
        Video(np.zeros((2, 4, 4)), readouts_per_frame=2).velocity(0)


def test_videos_that_cannot_be_used_are_refused(tmp_path):
    frames = np.zeros((3, 4, 4))
    with pytest.raises(InputError, match="readouts_per_frame is 0.5, but it must be a number of at least 1"):
        Video(frames, readouts_per_frame=0.5)
    with pytest.raises(InputError, match=r"The video has 1 frame\(s\), but there must be two"):
        Video(frames[:1], readouts_per_frame=2)
    with pytest.raises(
        InputError, match="Time 9 is outside the video: its 3 frames, 2 readouts apart, last from spike"
    ):
        Video(frames, readouts_per_frame=2).frame(9.0)
    with pytest.raises(InputError, match="Time -1 is outside the video"):
        Video(frames, readouts_per_frame=2, key=-1.0)
    with pytest.raises(
        InputError, match="Frame 1 of the video has 5 rows and 4 columns, but the ones before it have 4"
    ):
        Video([np.zeros((4, 4)), np.zeros((5, 4))], readouts_per_frame=2).frame(1.0)
    with pytest.raises(InputError, match="Frame 0 of the video holds values from 3 to 3"):
        Video(frames + 3, readouts_per_frame=2)
    with pytest.raises(InputError, match="nowhere is not a folder"):
        Video(tmp_path / "nowhere", readouts_per_frame=2)
    with pytest.raises(InputError, match="holds no pictures: one per frame is needed"):
        Video(tmp_path, readouts_per_frame=2)
