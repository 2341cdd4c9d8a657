uniform mat4 clip_from_world;

void main() {
    gl_Position = clip_from_world * vec4(in_center + turned(in_quaternion, in_position * in_half), 1.0);
}
