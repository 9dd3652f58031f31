#pragma once

#include <vector>

#include "core/common/image.hpp"

namespace planish {

/// An image with the grey values that count: above `low` and below `high`; NaN never counts, nor does what `seen` (of
/// the image's size, or empty) marks with 0.
struct Exposed {
    Image<const float> image;
    float low = 0, high = 0;
    Image<const unsigned char> seen = {};
};

/// Sum and number of the pixels that count over blocks of `factor` x `factor` pixels, those at the rim smaller.
void block_sums(const Exposed& exposed, int factor, int threads, const Image<float>& sum, const Image<float>& count);

/// What the low-pass over blocks says of the images of one camera, each (h, w), one to three images in the order of
/// `Exposed`.
struct ContrastPlan {
    std::vector<Image<const float>> level;     ///< expected grey value; NaN where unknown
    std::vector<Image<const float>> variance;  ///< of the noise of the image's contrast; NaN where unknown
    Image<const float> covariance = {};        ///< of the noise of the first and the last image; empty if there is none
    float noise_left = 1;                      ///< share of the noise that the low-pass does not take with it
    int factor = 1;
    float limit = 1;  ///< contrasts are clipped here
};

/// One camera's contrast: value and variance (H, W), NaN where no image counts, and the weight (h, w) of the first
/// image among all, 0 where it is unknown.
struct CameraContrast {
    Image<float> value, variance, first_weight;
};

/// Mean of the contrasts I / level - 1 of all images that count in a pixel, and its variance. Weights, constant over a
/// block, are those of the least variance, C^-1 1 for the covariance C of the images' noise; levels are interpolated
/// between the centres of blocks.
void camera_contrast(const std::vector<Exposed>& images, const ContrastPlan& plan, int threads,
                     const CameraContrast& out);

/// One camera's contrast on its own grid; `level` (h, w) is the grey value that it is relative to.
struct ContrastView {
    Image<const float> value, variance, level;
    int factor = 1;
};

/// An image (H, W), its variance, and sum and number (h, w) of its known pixels per block.
struct CompensatedImage {
    Image<float> image, variance, sum, count;
};

/// The image (1 + value) level and `gain` times its variance [grey levels], read at the places (H, W, 2) on the
/// camera's own grid by cubic convolution, whose weights give the noise; without places at its own pixels. NaN where a
/// place is none or its surroundings are not known. Only what `seen` (H, W) does not mark with 0 enters the sums.
void compensated_image(const ContrastView& view, const Image<const float>& place,
                       const Image<const unsigned char>& seen, float gain, int threads, const CompensatedImage& out);

/// One camera's image on the organising grid.
struct SeenImage {
    Image<const float> image, variance;  ///< (H, W); NaN where unknown
    Image<const float> expected;         ///< (h, w): grey value of an even albedo
    Image<const float> trust;            ///< (h, w): factor of the weight
};

/// Mean of image / expected - 1 over the cameras, weighted by trust / variance, and its standard deviation; NaN where
/// no camera knows the pixel or `valid` (H, W) is 0.
void merge_contrasts(const std::vector<SeenImage>& images, const Image<const unsigned char>& valid, int factor,
                     int threads, const Image<float>& value, const Image<float>& sigma);

}  // namespace planish
