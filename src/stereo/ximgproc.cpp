// cv::StereoSGBM with OpenCV's own weighted-least-squares filter, as its sample stereo_disparity_filter
// runs them: matches of both eyes, the fast global smoother with left-right confidence. Only what Stipple's
// filter is measured against; buffers are not pre-shaped.
#include <opencv2/calib3d.hpp>
#include <opencv2/core.hpp>
#include <opencv2/ximgproc/disparity_filter.hpp>

extern "C" int stipple_sgbm_wls(int width, int height, int disparities, const unsigned char* left, const unsigned char* right,
                                float* disparity) try {
    const int block = 3;
    const cv::Size padded(width + disparities, height);
    const cv::Rect view(disparities, 0, width, height);
    const auto pad = [&](const unsigned char* p) {
        cv::Mat image = cv::Mat::zeros(padded, CV_8UC1);
        cv::Mat(height, width, CV_8UC1, const_cast<unsigned char*>(p)).copyTo(image(view));
        return image;
    };
    const cv::Mat l = pad(left), r = pad(right);
    auto matcher = cv::StereoSGBM::create(0, disparities, block);
    matcher->setP1(24 * block * block);
    matcher->setP2(96 * block * block);
    matcher->setPreFilterCap(63);
    matcher->setMode(cv::StereoSGBM::MODE_SGBM_3WAY);
    auto filter = cv::ximgproc::createDisparityWLSFilter(matcher);
    auto other = cv::ximgproc::createRightMatcher(matcher);
    cv::Mat of_left, of_right, filtered;
    matcher->compute(l, r, of_left);
    other->compute(r, l, of_right);
    filter->setLambda(8000);
    filter->setSigmaColor(1.5);
    filter->filter(of_left, l, filtered, of_right, cv::Rect(), r);
    for (int y = 0; y < height; y++)
        for (int x = 0; x < width; x++) {
            const short d = filtered.at<short>(y, x + disparities);
            disparity[y * width + x] = d > 0 ? d / 16.0f : -1.0f;
        }
    return 0;
} catch (...) {
    return 1;
}
