/* The plant of jaxdrones (lagging rotors, drag, semi-implicit Euler) as an expert would write it for one CPU:
 * structure of arrays, drones of a block side by side in the vector registers, a block flown through all steps while
 * its state is in the cache, blocks shared by the threads. The order of operations is that of the Python.
 */
#include <math.h>
#include <string.h>

enum { BLOCK = 128, VECTOR = 16 }; /* drones flown together, floats of the widest register */

typedef struct {
    float mass, inertia[3], rotor_x[4], rotor_y[4], spin[4], kf, km, rise_time, fall_time, gravity, drag[3], dt;
} Vehicle;

enum { POS = 0, QUAT = 3, VEL = 7, OMEGA = 10, RPM = 13, ROWS = 17 };

static const float RADIANS_PER_SECOND = 2 * 3.14159265358979f / 60; /* per RPM */

static void step(const Vehicle *v, float (*restrict x)[BLOCK], float (*restrict command)[BLOCK], int lanes) {
#define AT(row) x[row][i]
#pragma omp simd
    for (int i = 0; i < lanes; i++) {
        const float dt = v->dt;
        float qx = AT(QUAT), qy = AT(QUAT + 1), qz = AT(QUAT + 2), qw = AT(QUAT + 3);
        const float shorten = 1 / sqrtf(qx * qx + qy * qy + qz * qz + qw * qw);
        qx *= shorten, qy *= shorten, qz *= shorten, qw *= shorten;

        float thrust = 0, roll = 0, pitch = 0, yaw = 0, speed = 0;
        for (int k = 0; k < 4; k++) {
            const float rpm = AT(RPM + k), square = rpm * rpm, error = command[k][i] - rpm;
            speed += rpm;
            thrust += v->kf * square;
            roll += v->rotor_y[k] * v->kf * square;
            pitch -= v->rotor_x[k] * v->kf * square;
            yaw += v->km * v->spin[k] * square;
            AT(RPM + k) = rpm + dt * error * (error > 0 ? 1 / v->rise_time : 1 / v->fall_time);
        }

        /* air velocity in the body frame, u + w t + u x t with the conjugate quaternion */
        const float vx = AT(VEL), vy = AT(VEL + 1), vz = AT(VEL + 2);
        float tx = 2 * (qy * vz - qz * vy), ty = 2 * (qz * vx - qx * vz), tz = 2 * (qx * vy - qy * vx);
        speed *= RADIANS_PER_SECOND;
        const float fx = -v->drag[0] * speed * (vx - qw * tx + qy * tz - qz * ty);
        const float fy = -v->drag[1] * speed * (vy - qw * ty + qz * tx - qx * tz);
        const float fz = -v->drag[2] * speed * (vz - qw * tz + qx * ty - qy * tx) + thrust;

        tx = 2 * (qy * fz - qz * fy), ty = 2 * (qz * fx - qx * fz), tz = 2 * (qx * fy - qy * fx);
        const float per_mass = 1 / v->mass;
        const float new_vx = vx + dt * per_mass * (fx + qw * tx + qy * tz - qz * ty);
        const float new_vy = vy + dt * per_mass * (fy + qw * ty + qz * tx - qx * tz);
        const float new_vz = vz + dt * (per_mass * (fz + qw * tz + qx * ty - qy * tx) - v->gravity);

        float ox = AT(OMEGA), oy = AT(OMEGA + 1), oz = AT(OMEGA + 2);
        const float *j = v->inertia;
        const float gx = oy * j[2] * oz - oz * j[1] * oy;
        const float gy = oz * j[0] * ox - ox * j[2] * oz;
        const float gz = ox * j[1] * oy - oy * j[0] * ox;
        ox += dt * (roll - gx) / j[0], oy += dt * (pitch - gy) / j[1], oz += dt * (yaw - gz) / j[2];

        /* exp(dt omega), as rotation.exp: a ratio of polynomials in a quarter of the angle */
        const float rx = dt * ox, ry = dt * oy, rz = dt * oz, s = (rx * rx + ry * ry + rz * rz) / 16;
        const float a = 135135 - s * (62370 - s * (3150 - s * 28)), b = 135135 - s * (17325 - s * (378 - s));
        const float per_norm = 1 / (a * a + s * b * b), half = a * b / 2 * per_norm;
        const float ex = rx * half, ey = ry * half, ez = rz * half, ew = 1 - 2 * s * b * b * per_norm;

        AT(POS) += dt * new_vx, AT(POS + 1) += dt * new_vy, AT(POS + 2) += dt * new_vz;
        AT(QUAT) = qw * ex + qx * ew + qy * ez - qz * ey;
        AT(QUAT + 1) = qw * ey - qx * ez + qy * ew + qz * ex;
        AT(QUAT + 2) = qw * ez + qx * ey - qy * ex + qz * ew;
        AT(QUAT + 3) = qw * ew - qx * ex - qy * ey - qz * ez;
        AT(VEL) = new_vx, AT(VEL + 1) = new_vy, AT(VEL + 2) = new_vz;
        AT(OMEGA) = ox, AT(OMEGA + 1) = oy, AT(OMEGA + 2) = oz;
    }
}

/* Rows first to first + count of an array (rows, n), and back; lanes beyond the last drone are copies of one that flies. */
static void load(float (*restrict to)[BLOCK], const float *from, int rows, long n, long count) {
    for (int row = 0; row < rows; row++)
        for (long i = 0; i < BLOCK; i++) to[row][i] = from[row * n + (i < count ? i : 0)];
}

static void store(float *to, float (*restrict from)[BLOCK], int rows, long n, long count) {
    for (int row = 0; row < rows; row++) memcpy(to + row * n, from[row], count * sizeof(float));
}

/* x is (17, n), command (4, n), row by row; the command is held. */
void fly(const Vehicle *vehicle, float *x, const float *command, long n, long steps, int threads) {
    const long blocks = (n + BLOCK - 1) / BLOCK;
#pragma omp parallel for schedule(static) num_threads(blocks < threads ? (int)blocks : threads)
    for (long first = 0; first < n; first += BLOCK) {
        float block[ROWS][BLOCK], held[4][BLOCK];
        const long count = n - first < BLOCK ? n - first : BLOCK;
        const int lanes = (count + VECTOR - 1) / VECTOR * VECTOR;
        load(block, x + first, ROWS, n, count);
        load(held, command + first, 4, n, count);
        for (long t = 0; t < steps; t++) step(vehicle, block, held, lanes);
        store(x + first, block, ROWS, n, count);
    }
}
