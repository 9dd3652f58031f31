#pragma once

#include <vector>

#include "core/image.hpp"

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

/// What the low-pass over blocks says of the images of one camera, each (h, w), K images in the order of `Exposed`.
struct ContrastPlan {
    std::vector<Image<const float>> inverse_level;  ///< 1 / expected grey value, interpolated between block centres
    std::vector<Image<const float>> weight;         ///< of the image's contrast, constant over a block; 0 = unknown
    std::vector<Image<const float>> noise;  ///< K x K: covariance of the contrasts' noise, constant over a block
    int factor = 1;
    float limit = 1;  ///< contrasts are clipped here
};

/// Weighted mean of the contrasts I / level - 1 of all images that count in a pixel, and its variance; NaN where none.
void camera_contrast(const std::vector<Exposed>& images, const ContrastPlan& plan, int threads,
                     const Image<float>& value, const Image<float>& variance);

/// One camera's contrast on its own grid; `level` (h, w) is the grey value that it is relative to.
struct ContrastView {
    Image<const float> value, variance, level;
    int factor = 1;
};

/// The image (1 + value) level and its variance [grey levels], read at the places (H, W, 2) on the camera's own grid by
/// cubic convolution, whose weights give the noise; without places at its own pixels. NaN where a place is none or its
/// surroundings are not known.
void compensated_image(const ContrastView& view, const Image<const float>& place, int height, int width, int threads,
                       const Image<float>& image, const Image<float>& variance);

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
