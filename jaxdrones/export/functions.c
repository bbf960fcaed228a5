static inline float NAME_sigmoid(float x)
{
    return 1.0f / (1.0f + expf(-x));
}

static inline void NAME_normalize(int n, const float x[], const float mean[], const float scale[], float clip,
                                  float y[])
{
    for (int i = 0; i < n; ++i) {
        const float z = (x[i] - mean[i]) * scale[i];
        y[i] = z < -clip ? -clip : z > clip ? clip : z;
    }
}

/* y = x kernel + bias for each row of x, with a kernel of n rows and m columns. */
static inline void NAME_dense(int rows, int n, int m, const float x[], const float kernel[], const float bias[],
                              float y[])
{
    for (int row = 0; row < rows; ++row, x += n, y += m) {
        for (int j = 0; j < m; ++j)
            y[j] = bias ? bias[j] : 0.0f;
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < m; ++j)
                y[j] += x[i] * kernel[i * m + j];
    }
}

/* Kernels of stride x stride x c numbers, on an image of h x w pixels with margins of zeros. */
static inline void NAME_convolution(int h, int w, int c, int rows, int columns, int m, int stride, int top, int left,
                                    const float x[], const float kernel[], const float bias[], float y[])
{
    for (int row = 0; row < rows; ++row)
        for (int column = 0; column < columns; ++column, y += m) {
            for (int j = 0; j < m; ++j)
                y[j] = bias[j];
            for (int k = 0; k < stride * stride * c; ++k) {
                const int v = row * stride + k / (stride * c) - top;
                const int u = column * stride + k / c % stride - left;
                if (v < 0 || v >= h || u < 0 || u >= w)
                    continue;
                for (int j = 0; j < m; ++j)
                    y[j] += x[(v * w + u) * c + k % c] * kernel[k * m + j];
            }
        }
}

/* Gated recurrent unit, with the gates reset, keep and new. */
static inline void NAME_gates(int n, const float inputs[], const float states[], float hidden[])
{
    for (int i = 0; i < n; ++i) {
        const float reset = NAME_sigmoid(inputs[i] + states[i]);
        const float keep = NAME_sigmoid(inputs[n + i] + states[n + i]);
        const float new_value = tanhf(inputs[2 * n + i] + reset * states[2 * n + i]);
        hidden[i] = keep * hidden[i] + (1.0f - keep) * new_value;
    }
}

static inline void NAME_add_to_rows(int rows, int m, const float x[], float y[])
{
    for (int i = 0; i < rows * m; ++i)
        y[i] += x[i % m];
}

/* Sum of rows of m features, weighted by the length of the first three of n numbers: 0 from the reach on. */
static inline void NAME_sum_of_rows(int rows, int m, int n, const float features[], const float x[], float fade,
                                    float inverse_reach, float small, float y[])
{
    for (int j = 0; j < m; ++j)
        y[j] = 0.0f;
    for (int row = 0; row < rows; ++row, features += m, x += n) {
        const float away = sqrtf(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + small);
        const float nearness = fade * (1.0f - away * inverse_reach);
        const float weight = nearness < 0.0f ? 0.0f : nearness > 1.0f ? 1.0f : nearness;
        for (int j = 0; j < m; ++j)
            y[j] += weight * features[j];
    }
}

/* From depths, m, to numbers from 1 at the camera to 0 at infinity. */
static inline void NAME_nearness(int n, const float x[], float depth_scale, float y[])
{
    for (int i = 0; i < n; ++i)
        y[i] = depth_scale / (depth_scale + (x[i] < 0.0f ? 0.0f : x[i]));
}

static inline void NAME_color(int pixels, const uint8_t x[], float y[])
{
    for (int i = 0; i < pixels; ++i)
        for (int j = 0; j < 3; ++j)
            y[3 * i + j] = (float)x[4 * i + j] / 255.0f;
}

static inline void NAME_copy(int rows, int n, int stride, const float x[], float y[])
{
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < n; ++j)
            y[i * stride + j] = x[i * n + j];
}

static inline void NAME_apply_tanh(int n, float y[])
{
    for (int i = 0; i < n; ++i)
        y[i] = tanhf(y[i]);
}

static inline void NAME_apply_relu(int n, float y[])
{
    for (int i = 0; i < n; ++i)
        y[i] = y[i] < 0.0f ? 0.0f : y[i];
}

static inline void NAME_apply_elu(int n, float y[])
{
    for (int i = 0; i < n; ++i)
        y[i] = y[i] > 0.0f ? y[i] : expm1f(y[i]);
}

static inline void NAME_apply_silu(int n, float y[])
{
    for (int i = 0; i < n; ++i)
        y[i] = y[i] * NAME_sigmoid(y[i]);
}
