"""Which pixels of a reduced image stand for those of the image as it came."""

from derender.detection.search.observation import nearest_pixels


def test_the_nearest_pixels_of_a_reduced_image():
    # reduced by 4 its pixels stand for 1, 5, 9; by 2 they stand for 0, 2, 4, 6, 8, 10
    assert nearest_pixels(6, 2, 3, 4).tolist() == [0, 0, 1, 1, 2, 2]
    assert nearest_pixels(4, 3, 4, 3).tolist() == [0, 1, 2, 3]
