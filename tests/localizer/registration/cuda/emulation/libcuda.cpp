// A stand-in for the NVIDIA driver, for tests: the part of its interface that the product calls, over
// host memory. Allocations lie between guards; a new allocation holds NaN, a freed one faults.
// An image is "emulated:PATH" of a library with the emulated kernels; streams run at once. It shows
// no device until stand_in_enable(1), so that code under test elsewhere in the process sees none.
#include <dlfcn.h>
#include <sys/mman.h>
#include <unistd.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <functional>
#include <map>
#include <mutex>
#include <string>
#include <vector>

namespace {
enum Result { success = 0, invalid_value = 1, no_device = 100, invalid_image = 200, not_found = 500,
              launch_failed = 719, capture_unsupported = 900 };
using Kernel = int (*)(void**, unsigned, unsigned, unsigned, char*, size_t);
struct Function { Kernel kernel; size_t bytes; };  // bytes: of its one parameter
struct Block { char* base; size_t bytes; size_t size; };

// Addresses without memory on both sides of an allocation: a kernel whose index is wrong by less
// writes there, which is noticed, and not into the memory of the process that runs the tests.
constexpr size_t guard = size_t{4} << 20;

std::recursive_mutex lock;
bool enabled = false;
unsigned fibre_order = 0;
std::map<uintptr_t, Block> blocks;
std::string problem;
long launches = 0, graph_launches = 0, allocations = 0, copied_to_device = 0, copied_to_host = 0;
using Work = std::vector<std::function<Result()>>;
Work* capturing = nullptr;

Result failed_with(std::string text) {
    if (problem.empty()) problem = std::move(text);
    return launch_failed;
}

// A device range must lie within one allocation.
bool inside(uintptr_t address, size_t size) {
    auto after = blocks.upper_bound(address);
    if (after == blocks.begin()) return false;
    const auto& [start, block] = *std::prev(after);
    return address + size <= start + block.size;
}

Result run(std::function<Result()> work) {
    if (capturing) {
        capturing->push_back(std::move(work));
        return success;
    }
    return work();
}
}  // namespace

#define API extern "C" __attribute__((visibility("default"))) int

API stand_in_enable(int on) { enabled = on; return 0; }
API stand_in_order(unsigned order) { fibre_order = order; return 0; }
API stand_in_problem(char* text, size_t size) {
    std::snprintf(text, size, "%s", problem.c_str());
    problem.clear();
    return 0;
}
API stand_in_counts(long* to) {
    const long counts[] = {launches, graph_launches, allocations, (long)blocks.size(),
                           copied_to_device, copied_to_host};
    std::memcpy(to, counts, sizeof counts);
    return 0;
}

API cuInit(unsigned) { return enabled ? success : no_device; }
API cuDriverGetVersion(int* version) { *version = 13000; return success; }
API cuDeviceGetCount(int* count) { *count = enabled; return success; }
API cuDeviceGet(int* device, int index) { *device = index; return index == 0 ? success : 101; }
API cuDeviceGetName(char* name, int size, int) {
    std::snprintf(name, size, "emulated GPU");
    return success;
}
API cuDeviceGetAttribute(int* value, int attribute, int) {
    *value = attribute == 75 ? 8 : attribute == 76 ? 7 : attribute == 16 ? 2 : attribute == 13 ? 1000000 : -1;
    return *value < 0 ? invalid_value : success;
}
API cuDevicePrimaryCtxRetain(void** context, int) { *context = &blocks; return success; }
API cuCtxSetCurrent(void* context) { return context == &blocks ? success : 201; }
API cuStreamCreate(void** stream, unsigned) { *stream = new int(0); return success; }

API cuMemAlloc(uintptr_t* address, size_t size) {
    std::lock_guard<std::recursive_mutex> hold(lock);
    const size_t page = sysconf(_SC_PAGESIZE), aligned = (size + 15) / 16 * 16;
    const size_t held = (aligned + page - 1) / page * page, bytes = held + 2 * guard;
    char* base = (char*)mmap(nullptr, bytes, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (base == MAP_FAILED) return 2;
    mprotect(base + guard, held, PROT_READ | PROT_WRITE);
    std::memset(base + guard, 0xff, held);
    *address = (uintptr_t)base + guard + held - aligned;
    blocks[*address] = {base, bytes, size};
    ++allocations;
    return success;
}
API cuMemFree(uintptr_t address) {
    std::lock_guard<std::recursive_mutex> hold(lock);
    auto found = blocks.find(address);
    if (found == blocks.end()) return invalid_value;
    // The addresses stay taken, so that a late access faults; the memory goes back.
    const Block& block = found->second;
    mmap(block.base, block.bytes, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED, -1, 0);
    blocks.erase(found);
    return success;
}
API cuMemAllocHost(void** address, size_t size) {
    *address = aligned_alloc(64, (size + 63) / 64 * 64);
    return success;
}
API cuMemFreeHost(void* address) { free(address); return success; }

API cuMemcpyHtoDAsync(uintptr_t to, const void* from, size_t size, void*) {
    std::lock_guard<std::recursive_mutex> hold(lock);
    return run([=] {
        if (!inside(to, size)) return failed_with("copy to the device leaves its allocation");
        std::memcpy((void*)to, from, size);
        copied_to_device += size;
        return success;
    });
}
API cuMemcpyDtoHAsync(void* to, uintptr_t from, size_t size, void*) {
    std::lock_guard<std::recursive_mutex> hold(lock);
    return run([=] {
        if (!inside(from, size)) return failed_with("copy from the device leaves its allocation");
        std::memcpy(to, (void*)from, size);
        copied_to_host += size;
        return success;
    });
}
API cuMemcpyDtoDAsync(uintptr_t to, uintptr_t from, size_t size, void*) {
    std::lock_guard<std::recursive_mutex> hold(lock);
    return run([=] {
        if (!inside(to, size) || !inside(from, size))
            return failed_with("copy within the device leaves its allocation");
        std::memmove((void*)to, (void*)from, size);
        return success;
    });
}
API cuStreamSynchronize(void*) { return problem.empty() ? success : launch_failed; }

API cuModuleLoadData(void** module, const void* image) {
    const char* text = (const char*)image;
    if (std::strncmp(text, "emulated:", 9)) return invalid_image;
    *module = dlopen(text + 9, RTLD_NOW | RTLD_LOCAL);
    return *module ? success : invalid_image;
}
API cuModuleGetFunction(void** function, void* module, const char* name) {
    const std::string symbol = std::string("emulated_") + name;
    void* kernel = dlsym(module, symbol.c_str());
    void* bytes = dlsym(module, (symbol + "_bytes").c_str());
    if (!kernel || !bytes) return not_found;
    *function = new Function{(Kernel)kernel, *(size_t*)bytes};
    return success;
}
API cuFuncGetAttribute(int* value, int, void*) { *value = 0; return success; }
API cuLaunchKernel(void* handle, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by,
                   unsigned bz, unsigned shared, void*, void** parameters, void** extra) {
    std::lock_guard<std::recursive_mutex> hold(lock);
    if (gy != 1 || gz != 1 || by != 1 || bz != 1 || shared || extra || !gx || !bx || bx > 1024)
        return invalid_value;
    const Function function = *(Function*)handle;
    // As the driver: the parameter is copied before the call returns.
    std::vector<char> copy((const char*)parameters[0], (const char*)parameters[0] + function.bytes);
    return run([=]() mutable {
        void* arguments[] = {copy.data()};
        char text[512];
        ++launches;
        if (function.kernel(arguments, gx, bx, fibre_order, text, sizeof text))
            return failed_with(text);
        return success;
    });
}

API cuStreamBeginCapture(void*, int) {
    std::lock_guard<std::recursive_mutex> hold(lock);
    if (capturing) return capture_unsupported;
    capturing = new Work;
    return success;
}
API cuStreamEndCapture(void*, void** graph) {
    std::lock_guard<std::recursive_mutex> hold(lock);
    *graph = capturing;
    capturing = nullptr;
    return *graph ? success : capture_unsupported;
}
API cuGraphInstantiateWithFlags(void** executable, void* graph, unsigned long long) {
    *executable = new Work(*(Work*)graph);
    return success;
}
API cuGraphDestroy(void* graph) { delete (Work*)graph; return success; }
API cuGraphExecDestroy(void* graph) { delete (Work*)graph; return success; }
API cuGraphLaunch(void* executable, void*) {
    std::lock_guard<std::recursive_mutex> hold(lock);
    ++graph_launches;
    for (auto& work : *(Work*)executable)
        if (Result result = work()) return result;
    return success;
}

using Clock = std::chrono::steady_clock;
API cuEventCreate(void** event, unsigned) { *event = new Clock::time_point; return success; }
API cuEventRecord(void* event, void*) { *(Clock::time_point*)event = Clock::now(); return success; }
API cuEventSynchronize(void*) { return success; }
API cuEventElapsedTime(float* ms, void* start, void* stop) {
    *ms = std::chrono::duration<float, std::milli>(*(Clock::time_point*)stop -
                                                   *(Clock::time_point*)start).count();
    return success;
}
API cuEventDestroy(void* event) { delete (Clock::time_point*)event; return success; }

// The bindings ask for every function by its base name and the version they were made for.
API cuGetProcAddress_v2(const char* name, void** function, int, uint64_t, int* status) {
    static void* self = [] {
        Dl_info info;
        dladdr((void*)&cuInit, &info);
        return dlopen(info.dli_fname, RTLD_NOW | RTLD_NOLOAD);
    }();
    std::string wanted = name;
    if (wanted == "cuGraphInstantiate") wanted = "cuGraphInstantiateWithFlags";
    if (wanted == "cuGetProcAddress") wanted = "cuGetProcAddress_v2";
    *function = dlsym(self, wanted.c_str());
    if (status) *status = *function ? 0 : 1;
    return *function ? success : not_found;
}
API cuGetProcAddress(const char* name, void** function, int version, uint64_t flags) {
    return cuGetProcAddress_v2(name, function, version, flags, nullptr);
}
