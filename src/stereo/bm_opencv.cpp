// cv::StereoBM behind four C functions. Buffers belong to the caller; nothing throws across.
#include <opencv2/calib3d.hpp>
#include <opencv2/core.hpp>

namespace {
struct Matcher {
    cv::Ptr<cv::StereoBM> bm;
    int width, height;
};
}  // namespace

extern "C" void* stipple_bm_new(int width, int height, int disparities, int block, int uniqueness) try {
    // A match must be in range on both sides; an image narrower than the range has none.
    if (width <= disparities + block || height <= block) return nullptr;
    auto bm = cv::StereoBM::create(disparities, block);
    bm->setUniquenessRatio(uniqueness);
    bm->setTextureThreshold(10);
    bm->setDisp12MaxDiff(1);        // left-right check, px
    bm->setSpeckleWindowSize(100);  // px of the smallest region kept
    bm->setSpeckleRange(2);         // px within a region
    return new Matcher{bm, width, height};
} catch (...) {
    return nullptr;
}

extern "C" void stipple_bm_free(void* handle) { delete static_cast<Matcher*>(handle); }

extern "C" int stipple_bm_compute(void* handle, const unsigned char* left, const unsigned char* right, short* disparity) try {
    auto* m = static_cast<Matcher*>(handle);
    const cv::Mat l(m->height, m->width, CV_8UC1, const_cast<unsigned char*>(left));
    const cv::Mat r(m->height, m->width, CV_8UC1, const_cast<unsigned char*>(right));
    cv::Mat d(m->height, m->width, CV_16SC1, disparity);
    m->bm->compute(l, r, d);
    return d.data == reinterpret_cast<unsigned char*>(disparity) ? 0 : 2;
} catch (...) {
    return 1;
}
