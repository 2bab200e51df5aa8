// cv::StereoBM and cv::StereoSGBM behind four C functions, and one that our rectification is tested
// against. Buffers belong to the caller; nothing throws across.
//
// Both answer nothing for the columns left of their disparity range, an eighth of the view. The
// images are therefore matched with that many black columns put before them: what is far away in
// that strip has its match inside the right image.
#include <opencv2/calib3d.hpp>
#include <opencv2/core.hpp>

namespace {
struct Matcher {
    cv::Ptr<cv::StereoMatcher> method;
    int width, height, pad;
    cv::Mat left, right, disparity;  // padded, shaped once
};

void check(cv::StereoMatcher& method) {
    method.setDisp12MaxDiff(1);        // left-right check, px
    method.setSpeckleWindowSize(100);  // px of the smallest region kept
    method.setSpeckleRange(2);         // px within a region
}

void* matcher(const cv::Ptr<cv::StereoMatcher>& method, int width, int height, int disparities, int block) {
    if (width <= disparities + block || height <= block) return nullptr;
    check(*method);
    const cv::Size padded(width + disparities, height);
    return new Matcher{method,
                       width,
                       height,
                       disparities,
                       cv::Mat::zeros(padded, CV_8UC1),
                       cv::Mat::zeros(padded, CV_8UC1),
                       cv::Mat(padded, CV_16SC1)};
}
}  // namespace

extern "C" void* stipple_bm_new(int width, int height, int disparities, int block, int uniqueness) try {
    auto bm = cv::StereoBM::create(disparities, block);
    bm->setUniquenessRatio(uniqueness);
    bm->setTextureThreshold(10);
    return matcher(bm, width, height, disparities, block);
} catch (...) {
    return nullptr;
}

extern "C" void* stipple_sgbm_new(int width, int height, int disparities, int block, int uniqueness, int p1, int p2) try {
    auto sgbm = cv::StereoSGBM::create(0, disparities, block, p1, p2);
    sgbm->setUniquenessRatio(uniqueness);
    sgbm->setPreFilterCap(63);  // of the horizontal gradient that is matched beside the grey; the most OpenCV takes
    sgbm->setMode(cv::StereoSGBM::MODE_SGBM);  // five directions, one pass, a few rows of costs in memory
    return matcher(sgbm, width, height, disparities, block);
} catch (...) {
    return nullptr;
}

extern "C" void stipple_matcher_free(void* handle) { delete static_cast<Matcher*>(handle); }

extern "C" int stipple_matcher_compute(void* handle, const unsigned char* left, const unsigned char* right, short* disparity) try {
    auto* m = static_cast<Matcher*>(handle);
    const cv::Rect view(m->pad, 0, m->width, m->height);
    const auto wrap = [&](const unsigned char* p) {
        return cv::Mat(m->height, m->width, CV_8UC1, const_cast<unsigned char*>(p));
    };
    wrap(left).copyTo(m->left(view));
    wrap(right).copyTo(m->right(view));
    m->method->compute(m->left, m->right, m->disparity);
    m->disparity(view).copyTo(cv::Mat(m->height, m->width, CV_16SC1, disparity));
    return 0;
} catch (...) {
    return 1;
}

// OpenCV's own map of rectification, in raw pixels. `k` and `rectified` are fx fy cx cy; `turn` is
// rect_from_cam, row by row.
extern "C" int stipple_rectification_map(int fisheye, const double* k, const double* distortion, const double* turn,
                                         const double* rectified, int width, int height, float* x, float* y) try {
    const auto matrix = [](const double* f) { return cv::Matx33d(f[0], 0, f[2], 0, f[1], f[3], 0, 0, 1); };
    const cv::Vec4d d(distortion[0], distortion[1], distortion[2], distortion[3]);
    const cv::Matx33d r(turn);
    const cv::Size size(width, height);
    cv::Mat map_x(size, CV_32FC1, x), map_y(size, CV_32FC1, y);
    if (fisheye)
        cv::fisheye::initUndistortRectifyMap(matrix(k), d, r, matrix(rectified), size, CV_32FC1, map_x, map_y);
    else
        cv::initUndistortRectifyMap(matrix(k), d, r, matrix(rectified), size, CV_32FC1, map_x, map_y);
    return 0;
} catch (...) {
    return 1;
}
