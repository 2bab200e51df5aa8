// cv::StereoBM behind three C functions. Buffers belong to the caller; nothing throws across.
//
// StereoBM answers nothing for the columns left of its disparity range, an eighth of the view.
// Both images are therefore matched with that many black columns put before them: what is far
// away in that strip has its match inside the right image.
#include <opencv2/calib3d.hpp>
#include <opencv2/core.hpp>

namespace {
struct Matcher {
    cv::Ptr<cv::StereoBM> bm;
    int width, height, pad;
    cv::Mat left, right, disparity;  // padded, shaped once
};
}  // namespace

extern "C" void* stipple_bm_new(int width, int height, int disparities, int block, int uniqueness) try {
    if (width <= disparities + block || height <= block) return nullptr;
    auto bm = cv::StereoBM::create(disparities, block);
    bm->setUniquenessRatio(uniqueness);
    bm->setTextureThreshold(10);
    bm->setDisp12MaxDiff(1);        // left-right check, px
    bm->setSpeckleWindowSize(100);  // px of the smallest region kept
    bm->setSpeckleRange(2);         // px within a region
    const cv::Size padded(width + disparities, height);
    return new Matcher{bm,
                       width,
                       height,
                       disparities,
                       cv::Mat::zeros(padded, CV_8UC1),
                       cv::Mat::zeros(padded, CV_8UC1),
                       cv::Mat(padded, CV_16SC1)};
} catch (...) {
    return nullptr;
}

extern "C" void stipple_bm_free(void* handle) { delete static_cast<Matcher*>(handle); }

extern "C" int stipple_bm_compute(void* handle, const unsigned char* left, const unsigned char* right, short* disparity) try {
    auto* m = static_cast<Matcher*>(handle);
    const cv::Rect view(m->pad, 0, m->width, m->height);
    const auto wrap = [&](const unsigned char* p) {
        return cv::Mat(m->height, m->width, CV_8UC1, const_cast<unsigned char*>(p));
    };
    wrap(left).copyTo(m->left(view));
    wrap(right).copyTo(m->right(view));
    m->bm->compute(m->left, m->right, m->disparity);
    m->disparity(view).copyTo(cv::Mat(m->height, m->width, CV_16SC1, disparity));
    return 0;
} catch (...) {
    return 1;
}
