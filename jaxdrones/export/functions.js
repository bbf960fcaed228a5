const f32 = Math.fround;

function sigmoid(x) {
  return f32(1 / f32(1 + f32(Math.exp(-x))));
}

function normalize(n, x, mean, scale, clip, y) {
  for (let i = 0; i < n; ++i) {
    y[i] = Math.min(Math.max(f32(f32(f32(x[i]) - mean[i]) * scale[i]), -clip), clip);
  }
}

// y = x kernel + bias for each row of x, with a kernel of n rows and m columns.
function dense(rows, n, m, x, kernel, bias, y) {
  for (let row = 0, from = 0, to = 0; row < rows; ++row, from += n, to += m) {
    for (let j = 0; j < m; ++j) y[to + j] = bias ? bias[j] : 0;
    for (let i = 0; i < n; ++i) {
      for (let j = 0; j < m; ++j) y[to + j] += f32(x[from + i] * kernel[i * m + j]);
    }
  }
}

// Kernels of stride x stride x c numbers, on an image of h x w pixels with margins of zeros.
function convolution(h, w, c, rows, columns, m, stride, top, left, x, kernel, bias, y) {
  for (let row = 0, at = 0; row < rows; ++row) {
    for (let column = 0; column < columns; ++column, at += m) {
      for (let j = 0; j < m; ++j) y[at + j] = bias[j];
      for (let k = 0; k < stride * stride * c; ++k) {
        const v = row * stride + Math.floor(k / (stride * c)) - top;
        const u = column * stride + Math.floor(k / c) % stride - left;
        if (v < 0 || v >= h || u < 0 || u >= w) continue;
        const pixel = x[(v * w + u) * c + k % c];
        for (let j = 0; j < m; ++j) y[at + j] += f32(pixel * kernel[k * m + j]);
      }
    }
  }
}

// Gated recurrent unit, with the gates reset, keep and new.
function gates(n, inputs, states, hidden) {
  for (let i = 0; i < n; ++i) {
    const reset = sigmoid(f32(inputs[i] + states[i]));
    const keep = sigmoid(f32(inputs[n + i] + states[n + i]));
    const value = f32(Math.tanh(f32(inputs[2 * n + i] + f32(reset * states[2 * n + i]))));
    hidden[i] = f32(keep * hidden[i]) + f32(f32(1 - keep) * value);
  }
}

function add_to_rows(rows, m, x, y) {
  for (let i = 0; i < rows * m; ++i) y[i] += x[i % m];
}

// Sum of rows of m features, weighted by the length of the first three of n numbers: 0 from the reach on.
function sum_of_rows(rows, m, n, features, x, fade, inverseReach, small, y) {
  for (let j = 0; j < m; ++j) y[j] = 0;
  for (let row = 0; row < rows; ++row) {
    const [a, b, c] = x.subarray(row * n, row * n + 3);
    const away = f32(Math.sqrt(f32(a * a + b * b + c * c + small)));
    const weight = Math.min(Math.max(f32(fade * f32(1 - f32(away * inverseReach))), 0), 1);
    for (let j = 0; j < m; ++j) y[j] += f32(weight * features[row * m + j]);
  }
}

// From depths, m, to numbers from 1 at the camera to 0 at infinity.
function nearness(n, x, depthScale, y) {
  for (let i = 0; i < n; ++i) y[i] = depthScale / f32(depthScale + Math.max(f32(x[i]), 0));
}

function color(pixels, x, y) {
  for (let i = 0; i < pixels; ++i) {
    for (let j = 0; j < 3; ++j) y[3 * i + j] = x[4 * i + j] / 255;
  }
}

function copy(rows, n, stride, x, y) {
  for (let i = 0; i < rows; ++i) {
    for (let j = 0; j < n; ++j) y[i * stride + j] = x[i * n + j];
  }
}

function apply_tanh(n, y) {
  for (let i = 0; i < n; ++i) y[i] = Math.tanh(y[i]);
}

function apply_relu(n, y) {
  for (let i = 0; i < n; ++i) y[i] = Math.max(y[i], 0);
}

function apply_elu(n, y) {
  for (let i = 0; i < n; ++i) y[i] = y[i] > 0 ? y[i] : Math.expm1(y[i]);
}

function apply_silu(n, y) {
  for (let i = 0; i < n; ++i) y[i] = y[i] * sigmoid(y[i]);
}
